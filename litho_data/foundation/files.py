"""Write files and folders atomically: they appear at their path completely or not at all."""

import contextlib
import errno
import glob
import os
import shutil
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from litho_data.foundation.errors import InputError


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, with the same suffix. The file that the ``with`` block writes
    there replaces ``path`` only if the block ends without an error.

    Raises:
        InputError: ``path`` is a folder, or cannot be written.
    """
    target = Path(path)
    if target.is_dir():
        raise InputError(f"cannot write {target}", got="a folder of that name", wanted="a file")
    prefix, suffix = f".{target.name}.", f".partial{target.suffix}"
    with writable(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        for left in target.parent.glob(f"{glob.escape(prefix)}*{glob.escape(suffix)}"):
            _remove_unless_held(left)
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=target.parent)
    temporary = Path(name)
    with os.fdopen(handle) as held:
        _lock(held)
        try:
            yield temporary
            temporary.chmod(0o666 & ~_umask())
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path, *, wait: bool = True) -> Iterator[Path]:
    """Yield an empty folder that replaces ``path`` if the ``with`` block ends without an error. An older
    folder at ``path`` stays in place until then.

    For a path that a user chose, use ``litho_data.foundation.begun.whole_folder`` instead.

    Args:
        wait: whether to wait if another process is writing the folder. If false, an InputError is raised
            instead.

    Raises:
        InputError: ``path`` cannot be written, or another process is writing it.
    """
    with unfinished(path, wait=wait) as work:
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
def unfinished(path: str | Path, *, wait: bool = False) -> Iterator[Path]:
    """Yield the folder ``.<name>.partial`` beside ``path``, including the files that a stopped process left
    there.

    Raises:
        InputError: ``path`` cannot be written, or another process is writing it already.
    """
    target = Path(path)
    if target.is_symlink() and not target.exists():
        raise InputError(
            f"cannot write {target}", got="a broken symbolic link", wanted="the path of a folder"
        )
    work = _work(target)
    while True:
        with writable(target):
            try:
                work.mkdir(parents=True, exist_ok=True)
            except FileExistsError:
                # The process that held the lock before may have removed the folder after ``mkdir`` found it.
                if work.exists() and not work.is_dir():
                    raise
                continue
            # The process that held the lock before may already have removed the lock file.
            with contextlib.suppress(FileNotFoundError):
                lock = locked(work / "lock", target, wait)
                if os.path.samestat(os.fstat(lock.fileno()), (work / "lock").stat()):
                    break
                lock.close()
    with lock:
        _put_back(work, target)
        yield work


def publish(new: Path, path: str | Path) -> None:
    """Rename a finished folder to ``path``. Call this within ``unfinished``. An older folder at ``path``
    stays until the new folder replaces it.
    """
    target = Path(path)
    if target.exists():
        target.replace(_work(target) / "old")
    try:
        new.replace(target)
    finally:
        _put_back(_work(target), target)


def clear_leftovers(folder: Path) -> None:
    """Remove the partial files and folders that a stopped process left below ``folder``."""
    for left in sorted(folder.rglob(".*.partial*")):
        if left.is_dir():
            _put_back(left, left.parent / left.name[1:].removesuffix(".partial"))
            shutil.rmtree(left)
        else:
            left.unlink(missing_ok=True)


def _work(target: Path) -> Path:
    return target.parent / f".{target.name}.partial"


def _put_back(work: Path, target: Path) -> None:
    """Move an older folder back to ``target`` if it was moved aside and no new folder took its place."""
    old = work / "old"
    if old.exists() and not target.exists():
        old.replace(target)
    shutil.rmtree(old, ignore_errors=True)


def locked(file: Path, target: Path, wait: bool = False) -> IO[str]:
    """Open the file for appending and lock it. The advisory lock ends when the file is closed or the process
    ends.

    Raises:
        InputError: another process is writing ``target`` and holds the lock.
    """
    stream = open(file, "a", encoding="utf-8")  # noqa: SIM115
    if not _lock(stream, wait):
        stream.close()
        raise InputError(f"{target} is being written by another process", hint="wait for it, or stop it")
    return stream


def _lock(stream: IO[str], wait: bool = False) -> bool:
    """Try to lock an open file, and return whether that succeeded. On a system without such locks, return
    True.
    """
    with contextlib.suppress(ImportError, OSError):
        import fcntl

        try:
            fcntl.flock(stream, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            return False
    return True


def _remove_unless_held(left: Path) -> None:
    """Remove a partial file that a stopped process left. A locked file is still being written, so
    it is kept.
    """
    with contextlib.suppress(FileNotFoundError), open(left) as stream:
        if _lock(stream):
            left.unlink()


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises:
        OSError: the file cannot be read, or is a pipe, from which reading could block forever.
        UnicodeDecodeError: the bytes are not UTF-8.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "a pipe or a device, not a file", str(path))
    return path.read_text(encoding="utf-8")


def parsed(file: Path, parse: Callable[[str], Any], what: str, wanted: str) -> Any:
    """Read a text file and parse it as TOML or JSON.

    Raises:
        InputError: the file does not exist or cannot be parsed. The message starts with ``what`` and says
            that ``wanted`` was expected.
    """
    try:
        return parse(read_text(file))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(what, got=error, wanted=wanted) from error


def table_beside(module: str, name: str) -> dict[str, Any]:
    """Read the TOML file ``name`` in the folder of a module; ``module`` is the module's ``__file__``."""
    return tomllib.loads(Path(module).with_name(name).read_text(encoding="utf-8"))


@contextmanager
def writable(target: Path) -> Iterator[None]:
    """Convert file-system errors to InputErrors. Use this while the first files of an output are written."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot write {target}", got=error, wanted="a path that can be written") from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
