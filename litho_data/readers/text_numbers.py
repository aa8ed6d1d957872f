"""Convert rows of text to numbers. The cells of a row are separated by blanks, tabs, semicolons or commas.
Numbers may have decimal commas, and words may stand in place of numbers. Damaged rows are detected.
"""

import io
import re
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from litho_data.foundation import Array, InputError
from litho_data.readers.text_blocks import Block

_EXPONENT = re.compile(r"[eE][+-]?\d+$")
_FORTRAN_EXPONENT = re.compile(r"(?<=[\d.])[dD](?=[-+]?\d)")
_AROUND_COMMA = re.compile(r"(?<![ \t])[ \t]*,[ \t]*(?=[^\s,]|\n|$)")
_OTHER_SEPARATOR = re.compile(r"[^\s;,][;\t ]+[^\s;,]")
_AT_COMMA, _WHOLE = re.compile(r"(\d*),(\d*)"), re.compile(r"(?<![\d,])\d+(?![\d,])")
_CELL = re.compile(r"[^\t\n]+")
_THOUSANDS = re.compile(r"-?\d{1,3}( \d{3})+([.,]\d*)?")
_SHOWN_CHARACTERS, _SHOWN_ROWS = 40, 2
_TRUNCATED = "the file may be truncated"


@dataclass(frozen=True)
class Table:
    """A table of numbers read from text.

    ``values`` has shape (rows, columns), with NaN in place of words. ``words`` maps every word in the table,
    except a word in the first cell, to the line where it first occurs. ``corner`` is the word in the first
    cell, or None if this cell contains a number.
    """

    values: Array
    words: dict[str, int]
    corner: str | None = None


def numbers_of(block: Block) -> Table:
    """Convert a block of text to numbers. Words become NaN, and so does the text ``nan``. An empty cell
    counts as an empty word.

    Decimal commas are accepted if the cells are not separated by commas. Exponents may be written as in
    Fortran, for example ``1.0D-07``.

    Raises:
        InputError: rows have different numbers of cells, different separators are mixed, or a number is too
            large. The message names the line and shows the first rows.
    """
    try:
        return _numbers("\n".join(block.rows), block.first_line)
    except InputError as error:
        rows = [row.strip() for row in block.rows if row.strip()][:_SHOWN_ROWS]
        shown = " | ".join(repr(row[:_SHOWN_CHARACTERS]) for row in rows)
        raise InputError(str(error), hint=f"the first rows are {shown}") from error


def _numbers(text: str, first_line: int) -> Table:
    text, separator = _plain(text, first_line)
    with suppress(ValueError):
        values = np.loadtxt(io.StringIO(text), delimiter=separator, dtype=float, comments=None, ndmin=2)
        if not np.isinf(values).any():
            return Table(values, {})
    return _cell_by_cell(text, separator, first_line)


def _plain(text: str, first_line: int) -> tuple[str, str | None]:
    """Return the text with decimal points in place of decimal commas, and the separator between its cells. If
    the separator is None, the cells are separated by blanks of any kind and number.

    Commas are taken as separators only if nothing else separates the cells. Otherwise they are decimal
    commas, and the text must not contain decimal points.

    Raises:
        InputError: commas stand beside another separator but are not decimal commas, as in
            ``1,234.5;2,345.6``; numbers seem to contain thousands separators; or commas seem to be both
            decimal commas and separators.
    """
    rows = [row.rstrip(" ") for row in text.replace("\x0c", " ").split("\n")]
    for mark in "\t;,":  # remove a separator that stands at the end, or at the start, of every row
        if all(row.endswith(mark) for row in rows if row):
            rows = [row[:-1] for row in rows]
        if all(row.startswith(mark) for row in rows if row):
            rows = [row[1:] for row in rows]
    text = "\n".join(rows)
    if "d" in text or "D" in text:
        text = _FORTRAN_EXPONENT.sub("e", text)
    separator = ";" if ";" in text else None
    if "," in text:
        tight = _AROUND_COMMA.sub(",", text)
        if not _OTHER_SEPARATOR.search(tight):
            separator = ","
            _refuse_decimal_commas(tight, first_line)
        elif "." in tight or tight != text:
            for line, row in enumerate(tight.split("\n"), start=first_line):
                if "," in row and _OTHER_SEPARATOR.search(row.strip()):
                    got = repr(row.strip()[:_SHOWN_CHARACTERS])
                    wanted = "cells with one separator, and no thousands separators"
                    raise InputError(f"line {line}", got=got, wanted=wanted)
        else:
            parts = _AT_COMMA.findall(text)
            if (
                all(before not in ("", "0") and len(after) == 3 for before, after in parts)
                and "e" not in text.lower()
                and _WHOLE.search(text)
            ):
                raise InputError(
                    f"line {first_line}",
                    got="commas before three digits",
                    wanted="no thousands separators",
                )
            text = text.replace(",", ".")
    if "\t" in text and all(_THOUSANDS.fullmatch(one[0].strip()) for one in _CELL.finditer(text)):
        got = repr(text[:_SHOWN_CHARACTERS])
        raise InputError(f"line {first_line}", got=got, wanted="no thousands separators")
    if separator is None and "\t" in text and " " not in text.replace("\t ", "\t").replace(" \t", "\t"):
        separator = "\t"
    return text, separator


def _refuse_decimal_commas(text: str, first_line: int) -> None:
    """Reject rows like ``0,9000,0,3100``, where commas seem to be both decimal commas and separators.

    Such rows are recognised by the lengths of their cells: every row has an even number of cells, all cells
    in even places have the same length, and no cell in an odd place has this length.
    """
    if "." in text:
        return
    rows = [row.split(",") for row in text.split("\n") if row]
    every, other = ({len(cell) for row in rows for cell in row[start::2]} for start in (1, 0))
    if len(every) == 1 and every.isdisjoint(other) and all(len(row) % 2 == 0 for row in rows):
        got = repr(",".join(rows[0])[:_SHOWN_CHARACTERS])
        raise InputError(
            f"line {first_line}", got=got, wanted="decimal commas or commas between cells, not both"
        )


def _cell_by_cell(text: str, separator: str | None, first_line: int) -> Table:
    rows = [
        (line, [cell.strip() for cell in row.split(separator)])
        for line, row in enumerate(text.split("\n"), start=first_line)
        if row.strip()
    ]
    width = max(len(cells) for _, cells in rows[1:]) if len(rows) > 1 else len(rows[0][1])
    if len(rows) > 2 and len(rows[0][1]) == width - 1:
        rows[0][1].insert(0, "")  # the corner between a row and a column of coordinates was left out
    width, width_line = len(rows[0][1]), rows[0][0]
    words: dict[str, int] = {}
    corner = rows[0][1][0] if _number(rows[0][1][0]) is None else None
    values = np.full((len(rows), width), np.nan)
    for number, (line, cells) in enumerate(rows):
        found = [_number(cell) for cell in cells]
        if len(cells) != width:
            for cell, value in zip(cells, found, strict=True):
                if value is None and cell:
                    raise InputError(f"line {line}", got=repr(cell[:24]), wanted="a number")
            wanted = f"{width} values as in line {width_line}"
            raise InputError(f"line {line}", got=f"{len(cells)} values", wanted=wanted, hint=_TRUNCATED)
        for column, (cell, value) in enumerate(zip(cells, found, strict=True)):
            if value is not None:
                values[number, column] = value
                # Python reads a number like 1e400 as infinity, which the file does not contain.
                if np.isinf(value) and "inf" not in cell.lower():
                    raise InputError(f"line {line}", got=repr(cell[:24]), wanted="a number below 1e308")
            elif number or column:
                words.setdefault(cell, line)
    return Table(values, words, corner)


def _number(cell: str) -> float | None:
    """Return the number in a cell, or None if the cell contains a word."""
    try:
        # Only Python reads 1_000 as a number.
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


def refuse_cut_end(text: str) -> None:
    """Reject a text that was cut off inside its last number. For example, 5.4e-007 cut to 5.4 would be read
    as 5.4 m.

    Raises:
        InputError: the text does not end with a line break, and the last number has a shorter exponent than
            the number before it, or has none although the number before it has one.
    """
    if text.endswith("\n"):
        return
    last_row = text[text.rfind("\n") + 1 :].split()
    if len(last_row) < 2:
        return
    before, last = _EXPONENT.search(last_row[-2]), _EXPONENT.search(last_row[-1])
    if before is not None and (last is None or len(last[0]) < len(before[0])):
        line = text.count("\n") + 1
        wanted = f"a number spelt like {last_row[-2]!r}"
        what = f"line {line} ends inside a number"
        raise InputError(what, got=repr(last_row[-1]), wanted=wanted, hint=_TRUNCATED)
