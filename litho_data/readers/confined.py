"""Run parsers of other projects in a child process, within limits of computing time and memory.

A damaged header can keep such a parser busy for minutes, make it ask for gigabytes, or crash it. When a
process first needs such a parser, it starts a child process, and then runs all such parsers in this child.
It starts another child only after a parser has exceeded a limit or crashed.
"""

import atexit
import importlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, TypeVar

from litho_data.foundation import InputError
from litho_data.readers.reader import DAMAGED, foreign_parser

T = TypeVar("T")

_MIB = 1 << 20
# The limits of computing time and memory. Each is the sum of a constant and a part that grows with the size
# of the file. Undamaged files need about a hundredth of the allowed time and a tenth of the allowed memory.
_COMPUTING_S, _COMPUTING_S_PER_MIB = 4.0, 1.0
_MEMORY_MIB, _MEMORY_PER_BYTE = 128, 64
# The longest wait for a result, in multiples of the allowed computing time. The wait is long enough for a
# parser on a busy computer. This limit also ends a parser that only waits, which uses no computing time.
_WAITING_PER_COMPUTING = 20
_START = "from litho_data.readers.confined import serve; serve({descriptor})"


def parse(function: Callable[[], T], path: Path, kind: str, parsers: tuple[str, ...]) -> T:
    """Run a function that parses a file, and return its result. Any error is raised as an InputError about
    the file.

    Args:
        function: the function, which takes no argument.
        path: the file that it parses. The limits depend on the size of the file.
        kind: name of the format, for messages.
        parsers: names of the modules of other projects that the function needs. If there are any, the
            function runs in the child process and must be picklable. On systems other than POSIX, the
            function always runs in the calling process.
    """
    guarded = partial(_guarded, function, kind)
    return _CHILD.call(guarded, path, parsers) if parsers and os.name == "posix" else guarded()


def _guarded(function: Callable[[], T], kind: str) -> T:
    with foreign_parser(kind):
        return function()


class _Child:
    """The child process. It is started when it is first needed, and started again if it has ended."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = 0

    def call(self, function: Callable[[], Any], path: Path, imports: tuple[str, ...]) -> Any:
        """Run the function in the child, and return its result.

        Raises:
            InputError: the function raised an InputError, took too long, needed too much memory or crashed.
        """
        size = path.stat().st_size
        computing_s = _COMPUTING_S + _COMPUTING_S_PER_MIB * size / _MIB
        memory = _MEMORY_MIB * _MIB + _MEMORY_PER_BYTE * size
        with self._lock:
            self._start()
            try:
                self._pipe.send((os.getcwd(), imports, function, computing_s, memory))
                if not self._pipe.poll(_WAITING_PER_COMPUTING * computing_s):
                    raise TimeoutError
                result, refusal = self._pipe.recv()
            except (EOFError, OSError) as error:
                raise InputError("cannot be read", got=self._end(error, computing_s), hint=DAMAGED) from error
            except BaseException:
                self.stop()  # otherwise, a late answer would be taken for the answer about the next file
                raise
        if refusal:
            raise InputError(refusal)
        return result

    def _start(self) -> None:
        # A forked copy of this process must start its own child instead of using the child of the original
        # process.
        if self._process is not None and self._owner == os.getpid() and self._process.poll() is None:
            return
        self._pipe, far_end = Pipe()
        paths = os.pathsep.join(path for path in sys.path if path)
        with far_end:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _START.format(descriptor=far_end.fileno())],
                pass_fds=[far_end.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        self._owner = os.getpid()

    def _end(self, error: Exception, computing_s: float) -> str:
        """End the child. Return the reason why it gave no result, as a text for a message."""
        assert self._process is not None
        if isinstance(error, TimeoutError):
            self._process.kill()
        code = self._process.wait()
        if code == -signal.SIGPROF or isinstance(error, TimeoutError):
            return f"no result after {computing_s:.0f} s of computing"
        return f"a parser that crashed (exit code {code})"

    def stop(self) -> None:
        """End the child, if this process started it."""
        if self._process is not None and self._owner == os.getpid():
            self._process.kill()
            self._process.wait()
            self._pipe.close()
            self._process = None


def serve(descriptor: int) -> None:
    """Receive functions from the parent process, run them, and send back their results, until the parent
    process has ended. This function runs in the child process.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe = Connection(descriptor)
    with suppress(EOFError):
        while True:
            folder, imports, function, computing_s, memory = pipe.recv()
            os.chdir(folder)
            for module in imports:
                importlib.import_module(module)
            try:
                with _limits(computing_s, memory):
                    answer = function(), ""
            except InputError as error:
                answer = None, str(error)
            pipe.send(answer)


@contextmanager
def _limits(computing_s: float, memory: int) -> Iterator[None]:
    """Limit the computing time, in seconds, and the additional memory, in bytes, of a ``with`` block.

    If the block computes for longer, a signal ends the process. If it needs more memory, Python raises
    MemoryError.
    """
    import resource

    unlimited = resource.getrlimit(resource.RLIMIT_AS)
    with suppress(OSError):  # only Linux states in this file how much memory is in use
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + memory, unlimited[1]))
    signal.setitimer(signal.ITIMER_PROF, computing_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, unlimited)


_CHILD = _Child()
atexit.register(_CHILD.stop)
