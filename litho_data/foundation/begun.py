"""Begin, continue and finish results that commands write as folders.

A command first declares two things: the name of its record file, which it writes last, and the fields of
this record that determine the result. The folder is then in one of four states:

=========  =======================================  ==========================================================
state      content of the folder                    what the command does
=========  =======================================  ==========================================================
free       missing or empty                         begins the result
begun      ``begun.json``, written before all else  continues it, if record and fields are the same
finished   the record                               repeats or continues it, if record and fields are the same
other      anything else                            refuses, and changes nothing
=========  =======================================  ==========================================================

A command may be stopped after any of its writes. If it is then run again, it ends with the same result.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from litho_data.foundation.files import atomic_folder, clear_leftovers, locked, writable
from litho_data.foundation.kinds import Facts
from litho_data.foundation.outputs import (
    read_record,
    require_own_folder,
    require_replaceable_folder,
    require_same,
)

BEGUN = "begun.json"


@dataclass(frozen=True)
class Begun:
    """A folder to which a command adds the files of its result. ``finished`` is true if the folder already
    contained the complete result when the command started.
    """

    folder: Path
    finished: bool


@contextmanager
def growing_folder(
    out: str | Path, record: str, facts: Facts | None = None, *, holds: str = ""
) -> Iterator[Begun]:
    """Yield a folder to which the files of a result are added one by one, so that a stopped run can resume.

    If the folder already contains this result, files that do not belong to the result are left alone. Only
    one process at a time may write the folder.

    Args:
        out: the folder; it is created if it is missing.
        record: name of the record file of a finished result, such as ``run.json``. The ``with`` block writes
            this file last.
        facts: fields of the record that determine the result. A folder whose record has other values of these
            fields is refused.
        holds: pattern of file names. Files with such names, such as designs that were made one by one, may be
            in the folder before the result is begun.

    Raises:
        InputError: ``out`` is a file, cannot be written, or is being written by another process. The error is
            also raised if ``out`` contains something other than this result, for example a result of the same
            command with other settings in ``facts``. All these errors are raised before the ``with`` block
            begins.
    """
    folder, mark = Path(out), Path(out) / BEGUN
    begun = _require_own(folder, record, facts or {}, holds)
    finished = (folder / record).exists() and not mark.exists()
    made = not folder.exists()
    with writable(folder):
        folder.mkdir(parents=True, exist_ok=True)
        stream = locked(mark, folder)
    with stream:
        with writable(folder):
            clear_leftovers(folder)
            if not begun:
                stream.truncate(0)
                json.dump({"record": record, **(facts or {})}, stream, indent=1)
                stream.flush()
        try:
            yield Begun(folder, finished)
        except BaseException:
            if [one.name for one in folder.iterdir()] == [BEGUN]:
                mark.unlink()
                if made:
                    folder.rmdir()
            raise
        mark.unlink(missing_ok=True)


@contextmanager
def whole_folder(
    out: str | Path, *holds: str, record: str = "", facts: Facts | None = None
) -> Iterator[Path]:
    """Yield an empty folder that replaces ``out`` as a whole if the ``with`` block ends without an error. A
    stopped run cannot be resumed.

    Args:
        out: the folder that will be replaced.
        holds: as for ``require_replaceable_folder``.
        record, facts: as for ``growing_folder``. If no record is named, any older result is replaced,
            whatever its settings.

    Raises:
        InputError: as for ``growing_folder``, or the folder contains anything besides an older result.
    """
    require_replaceable_folder(out, *holds)
    if record:
        require_same(Path(out), read_record(Path(out) / record), facts or {})
    with atomic_folder(out, wait=False) as folder:
        yield folder


def _require_own(folder: Path, record: str, facts: Facts, holds: str) -> bool:
    """Return whether this result was begun in the folder but not finished. Raise InputError if the folder
    contains anything that this result must not replace.
    """
    begun = read_record(folder / BEGUN)
    own = isinstance(begun, dict) and begun.get("record") == record
    # If a process was stopped before it wrote the content of ``begun.json``, the folder counts as empty.
    nothing = begun is None and [one.name for one in folder.glob("*")] == [BEGUN]
    require_own_folder(folder, record, *[BEGUN] * (own or nothing), *[holds] * bool(holds))
    require_same(folder, begun if own else read_record(folder / record), facts)
    return own
