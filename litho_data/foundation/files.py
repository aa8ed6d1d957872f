"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from litho_data.foundation.errors import InputError


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; it replaces ``path`` only if the block succeeds.

    Raises:
        InputError: ``path`` is a folder, or cannot be written.
    """
    target = Path(path)
    if target.is_dir():
        raise InputError(f"cannot write {target}", got="a folder of that name", wanted="a file")
    with writable(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".partial", dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yield an empty folder; it replaces ``path`` only on success, and an older folder stays until then.

    If a user chose the path, use ``litho_data.foundation.begun.whole_folder``.

    Raises:
        InputError: ``path`` cannot be written, or another process is writing it.
    """
    with unfinished(path) as work:
        new = work / "new"
        shutil.rmtree(new, ignore_errors=True)
        try:
            with writable(Path(path)):
                new.mkdir()
            yield new
            publish(new, path)
        finally:
            shutil.rmtree(work, ignore_errors=True)


@contextmanager
def unfinished(path: str | Path) -> Iterator[Path]:
    """Yield the folder ``.<name>.partial`` beside ``path``, with what a stopped process left in it.

    Raises:
        InputError: the place cannot be written, or another process is writing it.
    """
    target = Path(path)
    work = _work(target)
    with writable(target):
        work.mkdir(parents=True, exist_ok=True)
        lock = locked(work / "lock", target)
    with lock:
        _put_back(work, target)
        yield work


def publish(new: Path, path: str | Path) -> None:
    """Rename a finished folder to ``path``; within ``unfinished``, which keeps an older one until then."""
    target = Path(path)
    if target.exists():
        target.replace(_work(target) / "old")
    try:
        new.replace(target)
    finally:
        _put_back(_work(target), target)


def clear_leftovers(folder: Path) -> None:
    """Remove what a stopped process left of files and folders that it was writing below ``folder``."""
    for left in sorted(folder.rglob(".*.partial")):
        if left.is_dir():
            _put_back(left, left.parent / left.name[1:].removesuffix(".partial"))
            shutil.rmtree(left)
        else:
            left.unlink(missing_ok=True)


def _work(target: Path) -> Path:
    return target.parent / f".{target.name}.partial"


def _put_back(work: Path, target: Path) -> None:
    """An older folder that was put aside for a new one, which did not come."""
    old = work / "old"
    if old.exists() and not target.exists():
        old.replace(target)
    shutil.rmtree(old, ignore_errors=True)


def locked(file: Path, target: Path) -> IO[str]:
    """The file, open to add to, with an advisory lock that ends with it or with the process.

    Raises:
        InputError: another process holds it, as the one that writes ``target``.
    """
    stream = open(file, "a", encoding="utf-8")  # noqa: SIM115
    try:
        import fcntl

        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:  # a system without such locks does without
        pass
    except BlockingIOError as error:
        stream.close()
        raise InputError(
            f"{target} is being written by another process", hint="wait for it, or stop it"
        ) from error
    return stream


@contextmanager
def writable(target: Path) -> Iterator[None]:
    """Make the first files of an output; an error of the file system becomes an InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot write {target}", got=error, wanted="a place that can be written") from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
