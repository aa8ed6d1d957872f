"""Stop a process after a chosen number of writes, so that a restart can be compared with a whole run.

A write is a Python call that changes the file system: it opens a file for writing, makes a folder, or renames
or removes something. A stopped process ends at once without clean-up, as if killed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

_CHANGES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.link", "os.symlink"}
_STOPPED = 77


def writes_of(work: Callable[[], object], below: Path) -> int:
    """Run the work and return how many writes it makes inside a folder."""
    count = _watch(below, stop_before=None)
    work()
    return count[0]


def stopped_after(count: int, work: Callable[[], object], below: Path) -> bool:
    """Run the work in a child process, stop it after ``count`` writes, and return whether it got that far."""
    child = os.fork()
    if child == 0:
        _watch(below, stop_before=count)
        _end(work)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, _STOPPED), f"the work ended with exit code {code}"
    return code == _STOPPED


def _end(work: Callable[[], object]) -> None:
    code = 1
    try:
        work()
        code = 0
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
    finally:
        os._exit(code)


def _watch(below: Path, stop_before: int | None) -> list[int]:
    """Count the writes from now on, and end the process after ``stop_before`` of them."""
    count, root = [0], str(below.resolve())

    def seen(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            path, _, flags = arguments
            writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        elif event in _CHANGES:
            path, writes = arguments[0], True
        else:
            return
        if not writes or not isinstance(path, str | Path) or not os.path.abspath(path).startswith(root):
            return
        if count[0] == stop_before:
            os._exit(_STOPPED)
        count[0] += 1

    sys.addaudithook(seen)
    return count
