"""Find what a command leaves that is stopped after a chosen number of writes, so that a restart can be
compared with a whole run.

A write is a Python call that changes the file system: it opens a file for writing, makes a folder, or renames
or removes something. A stopped process ends at once without clean-up, as if killed.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

_CHANGES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.link", "os.symlink"}
_STOPPED = 77
# What is called before each write. Python cannot remove an audit hook, so there is one for all watches.
_watches: list[Callable[[str], None]] = []


def writes_of(work: Callable[[], object], below: Path) -> int:
    """Run the work and return how many writes it makes inside a folder."""
    with _watched(below, lambda count: None) as count:
        work()
    return count[0]


def states_after(stops: Collection[int], work: Callable[[], object], below: Path, copies: Path) -> list[Path]:
    """Run the work, and copy the folder ``below`` before each write that has one of the numbers ``stops``. A
    copy contains what a process leaves that is killed there: data that Python still buffers are missing.
    """
    with _watched(below, lambda count: count in stops and shutil.copytree(below, copies / f"{count}")):
        work()
    states = [copies / f"{stop}" for stop in stops]
    assert all(state.is_dir() for state in states), "the work made fewer writes"
    return states


def stopped_after(count: int, work: Callable[[], object], below: Path) -> bool:
    """Run the work in a child process, stop it after ``count`` writes, and return whether it got that far."""
    child = os.fork()
    if child == 0:
        with _watched(below, lambda made: made == count and os._exit(_STOPPED)):
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


@contextmanager
def _watched(below: Path, before: Callable[[int], object]) -> Iterator[list[int]]:
    """Count the writes, and call ``before`` with their number before each. Until it returns, no other thread
    begins a write.
    """
    count, root, turn = [0], str(below.resolve()), Lock()

    def seen(path: str) -> None:
        if path.startswith(root):
            with turn:
                before(count[0])
                count[0] += 1

    _hook_in()
    _watches.append(seen)
    try:
        yield count
    finally:
        _watches.remove(seen)


@cache
def _hook_in() -> None:
    sys.addaudithook(_hook)


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watches:
        return
    if event == "open":
        path, _, flags = arguments
        writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    elif event in _CHANGES:
        path, writes = arguments[0], True
    else:
        return
    if writes and isinstance(path, str | Path):
        for seen in _watches:
            seen(os.path.abspath(path))
