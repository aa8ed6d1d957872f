"""Run independent jobs in this process, in local processes, or on a Dask cluster, a few at a time."""

import asyncio
import os
import pickle
import sys
import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple, TypeVar

from litho_data.foundation import InputError
from litho_data.foundation.plugins import plugin_files
from litho_data.foundation.run_facts import run_facts, software_record
from litho_data.sharing.sending import Away, Known, received, sent

J = TypeVar("J")
R = TypeVar("R")

# Environment variables that limit the numerical libraries to one thread. The libraries read them when they
# are loaded, and Dask gives its workers the same values.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_CONNECT_S = 5.0
_TRIES = 3


class Pool(NamedTuple):
    """Running workers, to which ``submit`` gives a job. ``present`` returns the current number of workers. An
    error of a type in ``lost`` means that a job was lost because its worker died; ``fate`` is the phrase that
    messages use for what happened to this worker.

    ``tries`` is the maximum number of times that a job is started; ``restart`` is called before lost jobs are
    started again.
    """

    submit: Callable[..., Future[bytes]]
    present: Callable[[], int]
    lost: tuple[type[BaseException], ...]
    fate: str
    tries: int = 1
    restart: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class Workers:
    """Where jobs run: in this process, in local processes, or on a Dask cluster. Results are bit-identical
    for all three choices if every process has the same number of threads.

    Attributes:
        processes: number of local processes, with one thread each unless the environment says otherwise; 1
            means that jobs run in this process.
        dask: address of a Dask scheduler whose workers see the same files; replaces ``processes``.
        known: large objects that jobs use but that are not sent with them, because each worker makes them
            itself.
        pool: workers that are already running, as ``kept_open`` starts them; None to start workers for each
            call of ``run_jobs``.
    """

    processes: int = 1
    dask: str | None = None
    known: Known | None = None
    pool: Pool | None = None

    def __post_init__(self) -> None:
        if self.processes < 1:
            raise InputError("workers", got=self.processes, wanted="1 or more")

    @property
    def elsewhere(self) -> bool:
        """Return whether jobs run outside this process."""
        return self.dask is not None or self.processes > 1


HERE = Workers()


def run_jobs(
    function: Callable[[J], R],
    jobs: Sequence[J],
    workers: Workers = HERE,
    *,
    name: Callable[[J], str] = str,
    apart: bool = False,
) -> Generator[tuple[J, R], None, None]:
    """Yield each job with its result, in the order in which the jobs finish.

    At most two jobs per worker are submitted at a time, so memory does not grow with the number of jobs. If
    local workers die, their jobs are run again, one at a time and at most twice. On a Dask cluster, the
    scheduler decides how often such jobs are repeated.

    Args:
        function: function that runs one job. It must be importable by name, and jobs and results must be
            picklable.
        name: function that returns the name by which messages refer to a job.
        apart: whether the function itself starts a separate process and waits for it. If so, local workers
            are threads instead of processes.

    Raises:
        InputError: there is no scheduler at the address, a worker has different software or several threads,
            or the worker of a job died.
    """
    if not workers.elsewhere or len(jobs) < (1 if workers.dask else 2):
        yield from ((job, function(job)) for job in jobs)
        return
    known = workers.known or Known(dict, {})
    names = {id(one): key for key, one in known.objects.items()}
    software = software_record() if workers.dask else None
    made = pickle.dumps(known.make)
    away = Away(function, made, os.getcwd(), run_facts()["command"], plugin_files(), software)
    with nullcontext(workers.pool) if workers.pool else _opened(workers, apart, len(jobs)) as pool:
        for number, answer in _tried(
            lambda one: pool.submit(away, sent(jobs[one], names)),
            len(jobs),
            pool,
            lambda one: name(jobs[one]),
        ):
            yield jobs[number], received(answer, known.objects)


def _tried(
    submit: Callable[[int], Future[R]], count: int, pool: Pool, name: Callable[[int], str]
) -> Iterator[tuple[int, R]]:
    """Run jobs number 0 to ``count - 1``, and yield the number and the result of each. Jobs whose worker died
    are tried again, one by one.
    """
    tries: Counter[int] = Counter()

    def begin(number: int) -> Future[R]:
        try:
            future = submit(number)
        except pool.lost as error:
            future = Future()
            future.set_exception(error)
        else:
            tries[number] += 1
        return future

    batches = [list(range(count))]
    while batches:
        lost: list[int] = []
        for number, future in _windowed(begin, batches.pop(0), pool.present):
            try:
                answer = future.result()
            except pool.lost as error:
                if tries[number] >= pool.tries:
                    raise InputError(
                        f"the worker of {name(number)} {pool.fate}",
                        hint="run the command again to resume; "
                        "if memory ran out, use fewer or larger workers",
                    ) from error
                lost.append(number)
            else:
                yield number, answer
        if lost:
            under_way = [number for number in lost if tries[number]]
            print(
                f"a worker died: running {', '.join(map(name, under_way))} again, one at a time",
                file=sys.stderr,
            )
            pool.restart()
            waiting = [number for number in lost if not tries[number]]
            batches = [*([number] for number in under_way), waiting, *batches]


@contextmanager
def kept_open(workers: Workers) -> Iterator[Workers]:
    """Start the workers once and keep them running for the whole ``with`` block. If they cannot start, raise
    the error at once.

    Raises:
        InputError: there is no scheduler at the address, or it has no worker.
    """
    if not workers.elsewhere:
        yield workers
        return
    with _opened(workers) as pool:
        yield replace(workers, pool=pool)


def _windowed(
    submit: Callable[[J], Future[R]], jobs: Iterable[J], count: Callable[[], int]
) -> Iterator[tuple[J, Future[R]]]:
    """Yield each job with its finished future, in the order in which the jobs finish. ``count()`` returns the
    number of workers; at most two jobs per worker are submitted at a time.
    """
    waiting = iter(jobs)
    running: dict[Future[R], J] = {}

    def fill() -> None:
        room = 2 * max(1, count()) - len(running)
        running.update({submit(job): job for job in islice(waiting, max(0, room))})

    fill()
    while running:
        done = wait(running, return_when=FIRST_COMPLETED).done
        finished = [(running.pop(future), future) for future in done]
        fill()
        yield from finished


def _opened(workers: Workers, apart: bool = False, most: int | None = None) -> AbstractContextManager[Pool]:
    if workers.dask is not None:
        return _dask(workers.dask)
    return _local(min(workers.processes, most or workers.processes), apart)


@contextmanager
def _local(count: int, apart: bool) -> Iterator[Pool]:
    from multiprocessing import get_context

    def opened() -> Executor:
        if apart:
            return ThreadPoolExecutor(count)
        # Processes are spawned instead of forked, because a forked copy of a process with threads may hang.
        return ProcessPoolExecutor(count, get_context("spawn"), initializer=_die_with_parent)

    def restart() -> None:
        executors.pop().shutdown(wait=False)
        executors.append(opened())

    executors = [opened()]
    before = os.environ.copy()
    os.environ.update({**ONE_THREAD, **before})
    try:
        yield Pool(
            lambda *job: executors[0].submit(*job),
            lambda: count,
            (BrokenProcessPool,),
            f"died {_TRIES} times",
            _TRIES,
            restart,
        )
    finally:
        executors[0].shutdown(wait=apart, cancel_futures=True)
        for variable in ONE_THREAD.keys() - before.keys():
            del os.environ[variable]


def _die_with_parent() -> None:
    """End this worker when its parent ends; otherwise, a worker whose parent was killed would wait forever
    for its next job.
    """
    from multiprocessing import parent_process

    def watch() -> None:
        parent = parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _dask(address: str) -> Iterator[Pool]:
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        raise InputError(
            "dask is not installed", hint="install it with pip install 'litholoop[cluster]'"
        ) from error
    try:
        _require_scheduler(address)
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, MemoryError) as error:
        # A MemoryError occurs if another program answers at the address: Dask takes its bytes for the size of
        # a message.
        said = str(error) or f"no answer in {_CONNECT_S:g} s"
        raise InputError(
            "Dask scheduler",
            got=f"none at {address} ({said})",
            wanted="the address of a running scheduler, for example tcp://host:8786",
        ) from error

    def count() -> int:
        try:
            return len(client.nthreads())
        except OSError:  # the running jobs will report that the scheduler is gone
            return 0

    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except TimeoutError as error:
            raise InputError(f"Dask scheduler {address}", got="no workers", wanted="at least one") from error
        executor = client.get_executor(pure=False)
        try:
            yield Pool(
                executor.submit,
                count,
                (KilledWorker, CancelledError),
                "died, and so did its replacements, or Dask's scheduler died",
            )
        finally:
            executor.shutdown(wait=False)


def _require_scheduler(address: str) -> None:
    """Raise InputError if no Dask scheduler answers at the address. If another program listens at the
    address, a Dask client without this check would wait for a long time and then crash.
    """
    from distributed.core import rpc

    async def ask() -> None:
        async with rpc(address) as scheduler:
            await asyncio.wait_for(scheduler.identity(), _CONNECT_S)

    # The check runs in a separate thread, because a notebook already runs an event loop.
    with ThreadPoolExecutor(1) as thread:
        thread.submit(asyncio.run, ask()).result()
