"""Where a result may be written: designs, scores and comparisons have files of the same name."""

from __future__ import annotations

from pathlib import Path

from litho_data.foundation.errors import InputError

_RECORDS = ("design.json", "score.json", "gap.json")


def require_own_folder(out: str | Path, record: str) -> None:
    """Accept ``out`` for the result whose record is the file ``record``.

    Raises:
        InputError: a file, or the folder of a result of another kind, whose report would be overwritten.
    """
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise InputError("--out", got=f"{folder}, which is a file", wanted="a folder")
    for other in _RECORDS:
        if other != record and (folder / other).exists():
            raise InputError(
                "--out",
                got=f"{folder}, which holds {other}",
                wanted="a folder of its own",
                hint=f"for example {folder / Path(record).stem}",
            )
