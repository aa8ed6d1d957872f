"""Rules for the option ``--out`` of every command: a command replaces only its own older result.

A missing or empty folder is accepted. The folder of an earlier run is accepted if that run had the same
command, the same input (dataset, model or design) and the same settings. It is then resumed or repeated.
Anything else is refused, and nothing is changed.
"""

import json
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import read_text
from litho_data.foundation.kinds import Facts


def require_replaceable_folder(path: str | Path, *holds: str) -> None:
    """Accept a path that does not exist, an empty folder, or a folder in which all files belong to an older
    result. The files in its subfolders are checked too.

    Args:
        path: where the result will be.
        holds: paths relative to the folder, or patterns of such paths (``layouts/*.tif``), of all files that
            a result may contain. If a path names a subfolder, this subfolder may contain anything.

    Raises:
        InputError: the path is the current folder or a file, or the folder contains a file or a subfolder
            that does not belong to an older result. The message names what was found.
    """
    folder = Path(path)
    if folder.exists() and folder.samefile(Path.cwd()):
        raise InputError(
            "output",
            got=f"{folder}, which is the current folder",
            wanted="another folder, such as one inside it",
        )
    _refuse_a_file(folder)
    patterns = [pattern.split("/") for pattern in holds]
    paths = sorted(path.relative_to(folder) for path in folder.rglob("*"))
    # If a path and a pattern have different numbers of parts, only the parts that both have are compared. The
    # parent folders of a file therefore match the file's pattern too.
    strangers = (one for one in paths if not any(all(map(fnmatch, one.parts, held)) for held in patterns))
    if stranger := next(strangers, None):
        raise InputError(
            "output",
            got=f"{folder}, which holds {stranger.as_posix()}",
            wanted="a new folder, or one that contains only an older result, which will be replaced",
        )


def require_same(folder: Path, held: Any, facts: Facts) -> None:
    """Refuse a folder whose result was made with other settings. ``held`` is the record of the result in the
    folder, which may be finished or only begun. Raise InputError if ``first_difference`` finds a difference
    between ``held`` and ``facts``.
    """
    other = first_difference(held, json.loads(json.dumps(facts))) if isinstance(held, dict) else ""
    if other:
        raise InputError(
            "output",
            got=f"{folder}, which holds a result with other settings ({other.removeprefix('settings.')})",
            wanted="the same settings, or another folder",
            hint="choose another --out, or delete the folder",
        )


def first_difference(then: Facts, now: Facts, *above: str) -> str:
    """Return a text that names the first setting that differs between ``then`` and ``now``. If no setting
    differs, return "".

    A setting in ``now`` differs if it is missing in ``then`` or has another value there. A setting that is
    only in ``then`` differs if it lies at least two mappings deep in the record, for example among values
    that were set by name. If it lies less deep, for example in the mapping ``dataset``, it is ignored.

    Args:
        then, now: the older and the requested settings.
        above: if ``then`` and ``now`` are parts of whole records, the keys that lead to these parts, from the
            outermost to the innermost. For whole records, no keys are given.
    """
    path = "".join(f"{key}." for key in above)
    for name, after in now.items():
        if isinstance(after, dict):
            if deeper := first_difference(then.get(name) or {}, after, *above, name):
                return deeper
        elif name not in then or then[name] != after:
            short = name in then and not isinstance(after, list)
            return f"{path}{name}" + (f" = {then[name]!r}, but now {after!r} is requested" if short else "")
    within_a_field = len(above) > 1
    dropped = [name for name in then if name not in now] if within_a_field else []
    return f"{path}{dropped[0]} = {then[dropped[0]]!r}, but now no value is requested" if dropped else ""


def require_own_folder(path: str | Path, record: str, *begun: str) -> None:
    """Accept a path that does not exist, an empty folder, or a folder that contains a result of the same
    kind.

    A JSON file counts as the record of a result if its name matches its schema. For example, the name
    ``close_loop.json`` matches the schema ``litho-models/close-loop/1``.

    Args:
        path: folder of the result. If it already holds a result of this kind, other files in it are left
            alone.
        record: name of the record file of a finished result.
        begun: names, or patterns of names, of files that an interrupted run of the same kind leaves.

    Raises:
        InputError: the path is a file, or the folder contains the result of another command or anything else.
    """
    folder = Path(path)
    _refuse_a_file(folder)
    # Hidden files, such as those of file managers and version control, do not count as content.
    names = sorted(one.name for one in folder.glob("*") if not one.name.startswith("."))
    strangers = [name for name in names if name != record and _is_record(folder / name)]
    if not strangers and not any(fnmatch(name, mark) for name in names for mark in (record, *begun)):
        strangers = names
    if strangers:
        store = "zarr.json" in names
        raise InputError(
            "output",
            got=f"{folder}, which {'is a dataset store' if store else f'holds {strangers[0]}'}",
            wanted="a new folder, or one to which only this command has written",
            hint="" if store else f"for example {folder / Path(record).stem}",
        )


def _refuse_a_file(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError("output", got=f"{folder}, which is a file", wanted="a new folder")


def _is_record(file: Path) -> bool:
    content = read_record(file) if file.suffix == ".json" else None
    schema = content.get("schema") if isinstance(content, dict) else None
    return isinstance(schema, str) and schema.split("/")[1:2] == [file.stem.replace("_", "-")]


def read_record(file: Path) -> Any:
    """Return the content of a JSON file; return None if it cannot be read."""
    try:
        return json.loads(read_text(file))
    except (OSError, ValueError, RecursionError):
        return None
