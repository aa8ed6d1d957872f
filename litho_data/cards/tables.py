"""Read the two files to which a card may refer: the table of the ids, and the full scales of images."""

import csv
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import get_args

from litho_data.cards.card import Use
from litho_data.foundation.errors import InputError, require_known
from litho_data.foundation.files import parsed
from litho_data.foundation.kinds import YX
from litho_data.foundation.quantities import ORDER
from litho_data.foundation.units import is_length
from litho_data.readers.registry import formats
from litho_data.readers.text_blocks import read_text
from litho_data.store.schema import OPTIONAL_COLUMNS, TEXT_COLUMNS, Surround

SAFE_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._+-]*")
READ_COLUMNS = ("unit", "size_um", "format", "channel", "fast_axis")
"""What the table may say about single scans; these entries replace those in the card's ``[scan]``."""
COLUMNS = ("id", "order", *OPTIONAL_COLUMNS, *TEXT_COLUMNS, *READ_COLUMNS, "use")
_NUMBERS = ("order", *OPTIONAL_COLUMNS, "size_um")
_ALLOWED = {"turned_deg": (0.0, 90.0, 180.0, 270.0), "direction": (1.0, -1.0)}


def read_table(path: Path) -> dict[str, dict[str, str]]:
    """Return the rows of a card's CSV table by id, without empty cells, after checking all other cells.

    The reader accepts what spreadsheets write in any language: cells separated by commas, semicolons or tabs,
    text that may be UTF-16, and decimal commas if commas do not separate cells.

    Raises:
        InputError: an unreadable file, an unknown column, an id that is no plain name, or a cell of the wrong
            kind.
    """
    try:
        lines = read_text(path).splitlines()
        separator = max(",;\t", key=(lines or [""])[0].count)
        reader = csv.DictReader(lines, strict=True, restkey="(too many cells)", delimiter=separator)
        rows = list(reader)
        columns = list(reader.fieldnames or ())
    except (OSError, InputError, csv.Error) as error:
        raise InputError(f"cannot read table {path}", got=error, wanted="a CSV file") from error
    unknown = [name for name in columns if name not in COLUMNS]
    if unknown or "id" not in columns:
        raise InputError(f"columns of {path}", got=columns, wanted=f"id and any of {', '.join(COLUMNS[1:])}")
    table: dict[str, dict[str, str]] = {}
    for number, row in enumerate(rows, start=2):
        filled = {
            key: value.strip() for key, value in row.items() if isinstance(value, str) and value.strip()
        }
        if separator != ",":
            filled |= {key: filled[key].replace(",", ".") for key in _NUMBERS if key in filled}
        _check_row(filled, f"{path} line {number}", "(too many cells)" in row, "order" in columns)
        if filled["id"] in table:
            raise InputError(f"{path} line {number}: id", got=repr(filled["id"]), wanted="each id once")
        table[filled.pop("id")] = filled
    return table


def _check_row(row: Mapping[str, str], what: str, overfull: bool, needs_order: bool) -> None:
    if overfull:
        raise InputError(f"{what}: cells", got="more cells than columns")
    scan_id = row.get("id", "")
    if not SAFE_ID.fullmatch(scan_id):
        raise InputError(f"{what}: id", got=repr(scan_id), wanted="an id without a path")
    order = row.get("order", "")
    if needs_order and not (order.lstrip("-").isdecimal() and ORDER.holds(order)):
        raise InputError(f"{what}: order", got=repr(row.get("order", "")), wanted="a whole number")
    require_known(f"{what}: use", row.get("use", "dataset"), get_args(Use))
    for name in OPTIONAL_COLUMNS:
        if name in row:
            OPTIONAL_COLUMNS[name].require(f"{what}: {name}", row[name])
        if name in row and float(row[name]) not in _ALLOWED.get(name, (float(row[name]),)):
            wanted = " | ".join(f"{value:g}" for value in _ALLOWED[name])
            raise InputError(f"{what}: {name}", got=repr(row[name]), wanted=wanted)
    if "unit" in row and not is_length(row["unit"]):
        raise InputError(f"{what}: unit", got=repr(row["unit"]), wanted="a length, such as nm")
    if "size_um" in row and not size_of(row["size_um"]):
        raise InputError(
            f"{what}: size_um",
            got=repr(row["size_um"]),
            wanted="one side in µm, or height x width, such as 54 x 27",
        )
    for name, known in (
        ("format", ("auto", *formats())),
        ("fast_axis", ("x", "y")),
        ("surround", get_args(Surround)),
    ):
        require_known(f"{what}: {name}", row.get(name, known[0]), known)


def size_of(text: str) -> YX | None:
    """Read (y, x) from a cell with one side, or with both sides separated by ``x``; return None if it has
    neither.
    """
    sides = [one.strip() for one in re.split("[x×]", text)]
    if len(sides) > 2 or not all(_is_finite(one) and float(one) > 0 for one in sides):
        return None
    return float(sides[0]), float(sides[-1])


def _is_finite(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def read_full_scales(path: Path) -> dict[str, float]:
    """Read the height of the largest grey value, as µm, per file name or id, from a JSON object in metres.

    Raises:
        InputError: no such file, no JSON object, or a value that is not a positive number.
    """
    content = parsed(path, json.loads, f"cannot read {path}", "a JSON object, m per id")
    if not isinstance(content, dict):
        raise InputError(f"content of {path}", got=type(content).__name__, wanted="a JSON object, m per id")
    for key, value in content.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
            raise InputError(f"{path}: {key}", got=repr(value), wanted="a positive number of metres")
    return {key: float(value) * 1e6 for key, value in content.items()}
