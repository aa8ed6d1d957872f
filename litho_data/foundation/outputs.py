"""The door for folders that a command writes as a whole: what is not its own result is never replaced."""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path

from litho_data.foundation.errors import InputError


def require_replaceable_folder(path: str | Path, *holds: str) -> None:
    """Accept a path that is free, an empty folder, or a folder with nothing in it but an older result.

    Args:
        path: where the result will be.
        holds: names, or patterns of names, of everything that such a result holds.

    Raises:
        InputError: the folder that one works in, a file, or a folder with something else in it; the
            message names it.
    """
    folder = Path(path)
    if folder.resolve() == Path.cwd():
        raise InputError("output", got=f"{folder}, the current folder", wanted="a folder in it, or elsewhere")
    if folder.exists() and not folder.is_dir():
        raise InputError("output", got=f"{folder}, which is a file", wanted="a new folder")
    names = sorted(child.name for child in folder.iterdir()) if folder.exists() else []
    strangers = [name for name in names if not any(fnmatch(name, pattern) for pattern in holds)]
    if strangers:
        raise InputError(
            "output",
            got=f"{folder}, which holds {strangers[0]}",
            wanted="a new folder, or one with nothing but an older result, which is replaced",
        )
