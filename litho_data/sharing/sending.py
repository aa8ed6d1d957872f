"""Send a function and one of its jobs to another process, and send the result back."""

import contextlib
import ctypes
import os
import pickle
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from io import BytesIO
from typing import Any

from litho_data.foundation import Facts, InputError
from litho_data.foundation.plugins import load_plugins
from litho_data.foundation.run_facts import running_command, software_record

# Options of the C function mallopt: their numbers, and the values that the C library arrives at by itself if
# the options are not set.
_MALLOC = {"M_MMAP_THRESHOLD": (-3, 32 << 20), "M_TRIM_THRESHOLD": (-1, 64 << 20)}


@dataclass(frozen=True)
class Known:
    """Large objects that jobs use but that are not sent to other processes. Every process makes these objects
    itself, and the pickled jobs and results contain only their names.

    ``objects`` are the objects of this process, keyed by name. ``make`` is a function with which another
    process makes equal objects with the same names. It must be importable by name, or be a
    ``functools.partial`` of such a function. A process keeps only the objects that it made most recently.
    """

    make: Callable[[], Facts]
    objects: Facts


@dataclass(frozen=True)
class Away:
    """A wrapper of a function. Another process calls it to run the function in the working directory of this
    process. Results of the function record the command line of this process.

    ``plugins`` are plug-in files that the other process loads first. ``software`` states the versions and the
    commit that a Dask worker must also have; it is None for local processes.
    """

    function: Callable[[Any], Any]
    make: bytes
    folder: str
    command: str
    plugins: Sequence[str]
    software: Facts | None

    def __call__(self, job: bytes) -> bytes:
        load_plugins(self.plugins)
        if self.software is not None:
            _require_alike(self.software, self.folder)
            _keep_freed_memory()
        with contextlib.chdir(self.folder), running_command(self.command):
            objects = _made(self.make)
            result = self.function(received(job, objects))
        return sent(result, {id(one): key for key, one in objects.items()})


@lru_cache(maxsize=1)
def _made(make: bytes) -> Facts:
    made: Facts = pickle.loads(make)()
    return made


def sent(content: Any, names: Mapping[int, str]) -> bytes:
    """Pickle any object. The objects of ``Known`` inside it are replaced by their names; ``names`` maps the
    ``id()`` of each of them to its name.
    """
    stream = BytesIO()
    _Sender(stream, names).dump(content)
    return stream.getvalue()


def received(content: bytes, objects: Facts) -> Any:
    """Unpickle what ``sent`` has pickled. Where ``sent`` put the name of an object, insert the object that
    has this name in ``objects``.
    """
    return _Receiver(BytesIO(content), objects).load()


class _Sender(pickle.Pickler):
    def __init__(self, stream: BytesIO, names: Mapping[int, str]):
        super().__init__(stream, pickle.HIGHEST_PROTOCOL)
        self._names = names

    def persistent_id(self, content: Any) -> str | None:
        return self._names.get(id(content))


class _Receiver(pickle.Unpickler):
    def __init__(self, stream: BytesIO, objects: Facts):
        super().__init__(stream)
        self._objects = objects

    def persistent_load(self, name: str) -> Any:
        return self._objects[name]


def _require_alike(wanted: Facts, folder: str) -> None:
    """Refuse to run on a Dask worker that has several threads, other software or other files than this
    process, because its results could differ. The check is made for every job, because workers may join and
    leave.
    """
    from distributed import get_worker

    worker = get_worker()
    if worker.state.nthreads > 1:
        # Random seeds and thread counts are set for a whole process, so jobs that run in several threads of
        # one process would disturb each other.
        raise InputError(
            f"Dask worker {worker.address}",
            got=f"{worker.state.nthreads} threads",
            wanted="one thread; start more workers instead",
            hint="for example: dask worker ADDRESS --nworkers N --nthreads 1",
        )
    if not os.path.isdir(folder):
        raise InputError(
            f"Dask worker {worker.address}",
            got=f"no folder {folder}",
            wanted="the same files as on this machine",
        )
    own, there = ({**one["versions"], "commit": one["commit"]} for one in (software_record(), wanted))
    for package in sorted(own.keys() | there.keys()):
        found, asked = own.get(package), there.get(package)
        if found != asked:
            raise InputError(
                f"{package} of Dask worker {worker.address}",
                got=found or "none",
                wanted=f"{asked or 'none'}, as on this machine",
                hint="start the workers again in this environment",
            )


@cache
def _keep_freed_memory() -> None:
    """Let a Dask worker reuse freed memory, as processes do by default.

    Dask starts its workers with the environment variable MALLOC_TRIM_THRESHOLD_, with which every array above
    128 KiB gets new memory pages from the system. Requesting these pages would take a third of the time of a
    build.
    """
    if sys.platform == "linux" and (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)):
        for parameter, value in _MALLOC.values():
            mallopt(parameter, value)
