"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
    """Yield an empty temporary folder beside ``path``; it replaces ``path`` only on success.

    An older folder at ``path`` stays until the new one is complete. If a user chose the path, call
    ``litho_data.foundation.outputs.require_replaceable_folder`` first.

    Raises:
        InputError: ``path`` cannot be written.
    """
    target = Path(path)
    with writable(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".partial", dir=target.parent))
    temporary.chmod(0o777 & ~_umask())
    try:
        yield temporary
        replace_folder(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def replace_folder(new: Path, target: Path) -> None:
    """Rename a finished folder to ``target``; an older folder there goes back if that fails.

    If the process is killed between the two renames, the older folder stays whole in ``.<name>.….old``.
    """
    if not target.exists():
        new.replace(target)
        return
    retired = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".old", dir=target.parent))
    old = target.replace(retired / target.name)
    try:
        new.replace(target)
    except OSError:
        old.replace(target)
        raise
    finally:
        if target.exists():
            shutil.rmtree(retired)


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
