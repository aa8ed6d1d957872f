"""Pieces of work side by side, each in one thread from its beginning to its end.

PyTorch would share every single operation out. The features of a tile would then move from the cache of
one core to that of another, all threads would wait for the slowest after each operation, and sums would
be added up in an order, and so rounded in a way, that depends on how many threads there are.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, Lock
from typing import TypeVar

import torch

_Made = TypeVar("_Made")

# By process too: a copy that ``fork`` makes has the pools without their threads.
_pools: dict[tuple[int, int], ThreadPoolExecutor] = {}
_starting = Lock()


def one_thread_each(compute: Callable[[int], _Made], count: int) -> list[_Made]:
    """``compute(0)`` to ``compute(count - 1)`` in order, on as many threads as PyTorch may use here.

    Gradients are not recorded. The limits of the calling thread, which waits, and of all others stay as
    they are.
    """
    threads = torch.get_num_threads()
    without_gradient = torch.no_grad()(compute)
    if threads == 1:
        return list(map(without_gradient, range(count)))
    return list(_pool(threads).map(without_gradient, range(count)))


def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that live as long as the process, within which PyTorch uses one thread."""
    key = os.getpid(), threads
    with _starting:
        if key not in _pools:
            with ThreadPoolExecutor(1) as starter:
                _pools[key] = starter.submit(_start, threads).result()
        return _pools[key]


def _start(threads: int) -> ThreadPoolExecutor:
    """All threads of a pool, at once; to be called in a thread that ends with it.

    ``torch.set_num_threads`` holds for the thread that calls it and for those that use PyTorch for the
    first time from then on. The second part is taken back: what a new thread finds is found here.
    """
    for_new_threads = torch.get_num_threads()
    all_started = Barrier(threads)
    pool = ThreadPoolExecutor(threads, "one-thread-each", _limit_to_one)
    for start in [pool.submit(all_started.wait) for _ in range(threads)]:
        start.result()
    torch.set_num_threads(for_new_threads)
    return pool


def _limit_to_one() -> None:
    # The first use of PyTorch in a thread sets its limit, the first look at it too: it has to come before.
    torch.get_num_threads()
    torch.set_num_threads(1)
