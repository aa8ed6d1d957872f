"""Read the two files to which a dataset card may refer: the CSV table with facts about each id, and the JSON
file with the full-scale heights of integer images.
"""

import csv
import json
import math
import re
from pathlib import Path
from typing import Any, get_args

from litho_data.cards.card import Use
from litho_data.foundation import InputError, about, is_length, parsed, require_known
from litho_data.foundation.quantities import LENGTH_UM, ORDER
from litho_data.readers.registry import formats
from litho_data.readers.text_blocks import read_text
from litho_data.store.schema import OPTIONAL_COLUMNS, TEXT_COLUMNS, Surround

SAFE_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._+-]*")
SAFE_ID_RULE = "may contain only letters, digits, spaces and ._+-, and begins with a letter or digit"
READ_COLUMNS = ("unit", "size_um", "format", "channel", "fast_axis")
"""Columns of the card's CSV table that say how to read a single scan. Their values take precedence over the
entries with the same names in the card's ``[scan]`` table.
"""
COLUMNS = ("id", "order", *OPTIONAL_COLUMNS, *TEXT_COLUMNS, *READ_COLUMNS, "use")
_NUMBERS = ("order", *OPTIONAL_COLUMNS, "size_um")
_TOO_MANY = "(too many cells)"
_ALLOWED = {"turned_deg": (0.0, 90.0, 180.0, 270.0), "direction": (1.0, -1.0)}


def read_table(path: Path) -> dict[str, dict[str, Any]]:
    """Read and check a card's CSV table. Return a dict that maps each id to a dict of the values in its row,
    keyed by column name. Empty cells are left out.

    The function accepts what spreadsheet programs write in different languages: cells may be separated by
    commas, semicolons or tabs, the text may be UTF-16, and numbers may have decimal commas if cells are not
    separated by commas.

    Raises:
        InputError: the file is unreadable, a column is unknown, an id is not a plain name, or a cell is of
            the wrong kind.
    """
    try:
        lines = read_text(path).splitlines()
        separator = max(",;\t", key=(lines or [""])[0].count)
        reader = csv.DictReader(lines, strict=True, restkey=_TOO_MANY, delimiter=separator)
        rows = list(reader)
        columns = list(reader.fieldnames or ())
    except (OSError, InputError, csv.Error) as error:
        raise InputError(f"cannot read table {path}", got=error, wanted="a CSV file") from error
    unknown = [name for name in columns if name not in COLUMNS]
    if unknown or "id" not in columns:
        raise InputError(f"columns of {path}", got=columns, wanted=f"id and any of {', '.join(COLUMNS[1:])}")
    needed = [name for name in ("id", "order") if name in columns]
    table: dict[str, dict[str, Any]] = {}
    for number, row in enumerate(rows, start=2):
        with about(f"{path} line {number}"):
            if _TOO_MANY in row:
                raise InputError("cells", got="more cells than columns")
            cells = {key: (value or "").strip() for key, value in row.items()}
            if separator != ",":
                cells |= {key: cells[key].replace(",", ".") for key in _NUMBERS if key in cells}
            filled = {key: _value(key, text) for key, text in cells.items() if text or key in needed}
            if filled["id"] in table:
                raise InputError("id", got=repr(filled["id"]), wanted="each id once")
        table[filled.pop("id")] = filled
    return table


def _value(name: str, text: str) -> Any:
    """Convert the text of a cell in the column ``name`` to the type of this column.

    Raises:
        InputError: the text cannot be converted, such as a word in a column of numbers.
    """
    words = {
        "use": get_args(Use),
        "format": ("auto", *formats()),
        "fast_axis": ("x", "y"),
        "surround": get_args(Surround),
    }
    value: Any = text
    wanted = ""
    if name in words:
        require_known(name, text, words[name])
    elif name in OPTIONAL_COLUMNS:
        OPTIONAL_COLUMNS[name].require(name, text)
        value, allowed = float(text), _ALLOWED.get(name)
        wanted = " | ".join(f"{one:g}" for one in allowed) if allowed and value not in allowed else ""
    elif name == "id" and not SAFE_ID.fullmatch(text):
        wanted = "an id without a path"
    elif name == "order":
        whole = text.lstrip("-").isdecimal() and ORDER.holds(text)
        value, wanted = (int(text), "") if whole else (None, "a whole number")
    elif name == "unit" and not is_length(text):
        wanted = "a unit of length, such as nm"
    elif name == "size_um":
        sides = [one.strip() for one in re.split("[x×]", text)]
        sides = sides * 2 if len(sides) == 1 else sides
        if len(sides) == 2 and all(LENGTH_UM.holds(one) for one in sides):
            value = float(sides[0]), float(sides[1])
        else:
            wanted = "one side in µm, or y and x, such as 54 x 27"
    if wanted:
        raise InputError(name, got=repr(text), wanted=wanted)
    return value


def read_full_scales(path: Path) -> dict[str, float]:
    """Read a JSON file that states, for each image, the height in metres that the largest possible grey value
    stands for. Return these heights in µm, with the keys of the file, which are file names or ids.

    Raises:
        InputError: the file does not exist or is not a JSON object, or a value is not a positive number.
    """
    content = parsed(path, json.loads, f"cannot read {path}", "a JSON object with metres per id")
    if not isinstance(content, dict):
        raise InputError(
            f"content of {path}", got=type(content).__name__, wanted="a JSON object with metres per id"
        )
    for key, value in content.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
            raise InputError(f"{path}: {key}", got=repr(value), wanted="a positive number of metres")
    return {key: float(value) * 1e6 for key, value in content.items()}
