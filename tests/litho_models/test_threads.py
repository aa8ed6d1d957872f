"""Work is done in one thread each, and no other thread of the process notices."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
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


_LOADED = """
import importlib.abc, os, sys
class Watch(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "torch":
            print(os.environ.get("OMP_WAIT_POLICY"), os.environ.get("KMP_BLOCKTIME"))
            raise SystemExit(0)
sys.meta_path.insert(0, Watch())
"""


@pytest.mark.parametrize("given", [None, "ACTIVE"])
@pytest.mark.parametrize(
    "use",
    [
        "import litho_models; litho_models.load_frozen",
        "import litho_design; litho_design.design_hologram",
        "sys.argv = ['litho-models', 'zoo', 'list']; from litho_models.cli import main; main()",
        "sys.argv = ['litho-design', 'first', '--out', '/tmp']; from litho_design.cli import main; main()",
    ],
)
def test_threads_sleep_while_they_wait_unless_told_otherwise(use, given):
    """Spinning they take ten times as long beside one busy process; read when torch is loaded."""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {} if given is None else {"OMP_WAIT_POLICY": given}
    words = [sys.executable, "-c", _LOADED + use]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.stdout.split() == [given or "PASSIVE", "0"], done.stderr


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

        assert one_thread_each(look, 8) == [(number, 1, 2, 2) for number in range(8)]
    assert torch.get_num_threads() == 3


def test_threads_that_call_at_the_same_time_get_what_each_gets_alone(threads):
    threads(2)
    fields = [torch.randn(60, 60, generator=torch.Generator().manual_seed(seed)) for seed in range(6)]

    def powers(seed: int) -> list[torch.Tensor]:
        return one_thread_each(lambda number: torch.linalg.matrix_power(fields[seed], number), 9)

    alone = [powers(seed) for seed in range(6)]
    with ThreadPoolExecutor(6) as callers:
        together = list(callers.map(powers, range(6)))
    assert all(
        torch.equal(a, b) for made in zip(alone, together, strict=True) for a, b in zip(*made, strict=True)
    )


@pytest.mark.parametrize("count", [1, 3])
def test_gradients_are_not_recorded_and_an_error_is_raised(count, threads):
    threads(count)
    one = torch.ones(1, requires_grad=True)
    assert not any(made.requires_grad for made in one_thread_each(lambda number: one * number, 4))
    with pytest.raises(ZeroDivisionError):
        one_thread_each(lambda number: 1 // (number - 2), 4)
    assert torch.is_grad_enabled()
    assert torch.get_num_threads() == count


def test_a_copy_of_the_process_works_too(threads):
    threads(2)
    work = one_thread_each(lambda number: number, 2)
    copies = multiprocessing.get_context("fork")
    answers = copies.SimpleQueue()
    child = copies.Process(target=lambda: answers.put(one_thread_each(lambda number: number, 2)))
    child.start()
    child.join(20)
    if child.is_alive():
        child.kill()
    assert child.exitcode == 0
    assert answers.get() == work
