"""Every job runs once, however many workers and jobs there are, and few are under way at a time."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from litho_data.foundation.errors import InputError
from litho_data.foundation.workers import _windowed, run_jobs


def double(number: int) -> int:
    return 2 * number


@pytest.mark.parametrize("count", [0, 1, 3, 4, 5, 17])
def test_every_job_runs_once(count: int) -> None:
    with ThreadPoolExecutor(2) as executor:
        assert sorted(_windowed(executor, double, range(count), 4)) == [2 * number for number in range(count)]


def test_two_processes_do_the_same_as_this_one() -> None:
    assert sorted(run_jobs(double, range(9), workers=2)) == list(run_jobs(double, range(9)))


def test_jobs_are_taken_only_as_results_are() -> None:
    taken: list[int] = []

    class Jobs(list[int]):
        def __iter__(self) -> Iterator[int]:
            for number in range(100):
                taken.append(number)
                yield number

    with ThreadPoolExecutor(1) as executor:
        results = _windowed(executor, double, Jobs(), 4)
        next(results)
        # Four under way, and at most four more for those that finished meanwhile.
        assert len(taken) <= 8
        results.close()


def test_no_worker_is_bad_input() -> None:
    with pytest.raises(InputError, match="workers"):
        list(run_jobs(double, [1], workers=0))
