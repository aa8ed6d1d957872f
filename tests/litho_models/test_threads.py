"""Work is done in one thread each, and no other thread of the process notices."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from litho_models.fast import threads as threads_of_work
from litho_models.fast.threads import one_thread_each

pytestmark = pytest.mark.numerics


@pytest.fixture
def threads(monkeypatch):
    monkeypatch.setattr(threads_of_work, "_pools", {})
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_the_limits_of_all_other_threads_stay_as_they_are(threads):
    def limit_of_a_new_thread() -> int:
        with ThreadPoolExecutor(1) as new:
            return new.submit(torch.get_num_threads).result()

    threads(3)
    with ThreadPoolExecutor(1) as another:
        # The last one to set it decides for threads to come.
        another.submit(torch.get_num_threads).result()
        another.submit(torch.set_num_threads, 2).result()

        def look(number: int) -> tuple[int, ...]:
            its_limit = another.submit(torch.get_num_threads).result()
            return number, torch.get_num_threads(), its_limit, limit_of_a_new_thread()

        for number, seen in enumerate(one_thread_each(look, 8)):
            assert seen == (number, 1, 2, 2)
            assert torch.get_num_threads() == 3


@pytest.mark.parametrize("count", [1, 3])
def test_gradients_are_not_recorded_and_an_error_is_raised(count, threads):
    threads(count)
    one = torch.ones(1, requires_grad=True)
    assert not any(made.requires_grad for made in one_thread_each(lambda number: one * number, 4))
    with pytest.raises(ZeroDivisionError):
        list(one_thread_each(lambda number: 1 // (number - 2), 4))
    assert torch.is_grad_enabled()
    assert torch.get_num_threads() == count


def test_a_copy_of_the_process_works_too(threads):
    threads(2)
    work = list(one_thread_each(lambda number: number, 2))
    copies = multiprocessing.get_context("fork")
    answers = copies.SimpleQueue()
    child = copies.Process(target=lambda: answers.put(list(one_thread_each(lambda number: number, 2))))
    child.start()
    child.join(20)
    if child.is_alive():
        child.kill()
    assert child.exitcode == 0
    assert answers.get() == work
