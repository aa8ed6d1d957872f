"""Running the jobs of a build: in this process, in local processes, or on a Dask cluster, a few at a time."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from typing import TypeVar

from litho_data.foundation.errors import InputError

J = TypeVar("J")
R = TypeVar("R")


def run_jobs(
    function: Callable[[J], R], jobs: Sequence[J], workers: int = 1, dask: str | None = None
) -> Iterator[R]:
    """Results of ``function`` over the jobs, in the order in which they are finished.

    At most two jobs per worker are in progress, so memory does not grow with the number of jobs.

    Args:
        function: importable by name.
        jobs: picklable.
        workers: local processes; 1 runs the jobs in this process.
        dask: address of a running Dask scheduler whose workers see the same files; replaces ``workers``.

    Raises:
        InputError: fewer than one worker, or no scheduler at the address.
    """
    if workers < 1:
        raise InputError("workers", got=workers, wanted="1 or more")
    if dask is None and (workers == 1 or len(jobs) < 2):
        yield from map(function, jobs)
        return
    with _dask_executor(dask) if dask else _local_executor(min(workers, len(jobs))) as (executor, count):
        yield from _windowed(executor, function, jobs, 2 * count)


def _windowed(executor: Executor, function: Callable[[J], R], jobs: Sequence[J], window: int) -> Iterator[R]:
    waiting = iter(jobs)
    running: set[Future[R]] = {executor.submit(function, job) for job in islice(waiting, window)}
    while running:
        done, running = wait(running, return_when=FIRST_COMPLETED)
        running |= {executor.submit(function, job) for job in islice(waiting, len(done))}
        for future in done:
            yield future.result()


@contextmanager
def _local_executor(workers: int) -> Iterator[tuple[Executor, int]]:
    from multiprocessing import get_context

    # Spawned, because a forked copy of a process with threads may hang.
    with ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_die_with_parent
    ) as executor:
        try:
            yield executor, workers
        finally:
            executor.shutdown(wait=False, cancel_futures=True)


def _die_with_parent() -> None:
    """Workers of a killed parent would otherwise wait forever for their next job."""
    from multiprocessing import parent_process

    def watch() -> None:
        parent = parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _dask_executor(address: str) -> Iterator[tuple[Executor, int]]:
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError("dask", got="not installed", wanted="pip install 'litholoop[cluster]'") from error
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            "Dask scheduler", got=f"none at {address} ({error})", wanted="for example tcp://host:8786"
        ) from error
    with client:
        threads = sum(client.nthreads().values())
        if threads == 0:
            raise InputError(f"Dask scheduler {address}", got="no workers", wanted="at least one")
        with client.get_executor(pure=False) as executor:
            yield executor, threads
