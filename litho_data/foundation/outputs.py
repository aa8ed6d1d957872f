"""Checks of the folder that a command writes to: only an older result of its own is ever replaced."""

from __future__ import annotations

import json
from fnmatch import fnmatch
from pathlib import Path

from litho_data.foundation.errors import InputError


def require_replaceable_folder(path: str | Path, *holds: str) -> None:
    """Accept a path that is free, an empty folder, or a folder with nothing in it but an older result.

    Args:
        path: where the result will be.
        holds: names, or patterns of names, of everything that such a result holds.

    Raises:
        InputError: the current folder, a file, or a folder with something else in it, which the message
            names.
    """
    folder = Path(path)
    if folder.resolve() == Path.cwd():
        raise InputError("output", got=f"{folder}, the current folder", wanted="a folder in it, or elsewhere")
    _refuse_a_file(folder)
    names = sorted(child.name for child in folder.iterdir()) if folder.exists() else []
    strangers = [name for name in names if not any(fnmatch(name, pattern) for pattern in holds)]
    if strangers:
        raise InputError(
            "output",
            got=f"{folder}, which holds {strangers[0]}",
            wanted="a new folder, or one with nothing but an older result, which is replaced",
        )


def require_own_folder(path: str | Path, record: str) -> None:
    """Accept a folder for the result with the record file ``record``, if no other result is in it.

    A file is the record of a result if it is named after the kind in its schema, such as ``close_loop.json``
    with schema ``litho-models/close-loop/1``.

    Raises:
        InputError: a file, or the folder of a result of another kind, whose report would be overwritten.
    """
    folder = Path(path)
    _refuse_a_file(folder)
    for file in sorted(folder.glob("*.json")):
        if file.name != record and _is_record(file):
            raise InputError(
                "output",
                got=f"{folder}, which holds {file.name}",
                wanted="a folder of its own",
                hint=f"for example {folder / Path(record).stem}",
            )


def _refuse_a_file(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError("output", got=f"{folder}, which is a file", wanted="a new folder")


def _is_record(file: Path) -> bool:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    schema = content.get("schema") if isinstance(content, dict) else None
    return isinstance(schema, str) and schema.split("/")[1:2] == [file.stem.replace("_", "-")]
