"""Text matrices: one line per row, numbers apart by tabs, blanks, commas or semicolons; read and written."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import NoReturn

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import is_length, um_per
from litho_data.readers.reader import Channel, Reader

_TEXT_BYTES = bytes(range(0x20, 0x7F)) + b"\t\n\r\x0c"
_EMPTY_CELL = re.compile(rb"[,;][ \t]*[,;]")
_EXPONENT = re.compile(r"[eE][+-]?\d+$")
_FORTRAN_EXPONENT = re.compile(rb"(?<=[\d.])[dD](?=[-+]?\d)")
# No two neighbouring repetitions of these expressions match the same characters: otherwise a long line of
# blanks or digits takes hours.
_LEADING_NUMBER = re.compile(r"[-+\d.,eE]+")
_ASSIGNMENT = re.compile(r"[:=]")
_KEY = re.compile(r"[\w ()>-]+")
_COMMENT = (b"#", b"%", b";")
_NUMBER = re.compile(rb"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eEdD][-+]?\d+)?|[-+]?nan|[-+]?inf", re.IGNORECASE)
_AROUND_COMMA = re.compile(rb"(?<![ \t])[ \t]*,[ \t]*(?=[^\s,]|\r?\n|$)")
_OTHER_SEPARATOR = re.compile(rb"[^\s;,][;\t ]+[^\s;,]")
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_CELL_WIDTH = len("-1.2345e-007\t")
_MOST_HEADER_LINES = 1000
_SHOWN_ROWS, _SHOWN_CHARACTERS = 2, 40
# A row of two or three numbers in a long table is a point, not a line of a map.
_POINT_COLUMNS, _POINT_ROWS_PER_COLUMN = 3, 3
# Gwyddion exports these words in the language of its user.
_WIDTHS = ("Width", "Breite", "Largeur", "Larghezza", "Ancho", "Šířka")
_HEIGHTS = ("Height", "Höhe", "Hauteur", "Altezza", "Alto", "Výška")
_CHANNELS = ("Channel", "Kanal", "Canal", "Canale", "Kanál")
_TO_METRES = "height conversion factor (-> m)"


def read_channels(path: Path) -> list[Channel]:
    """The one channel of a text matrix; unit and size only if the lines above the numbers state them.

    Lines of words, and lines that start with ``#``, ``%`` or ``;``, are the header. A decimal comma is
    accepted if the cells are not separated by commas, and so is Fortran's ``1.0D-07``. ``nan`` marks a
    pixel that was not measured.

    Raises:
        InputError: binary or empty file, something that is no number, rows of different lengths, mixed
            separators, numbers too large, or a last number that was cut off; the message names the line
            and shows the first rows.
    """
    raw = _in_utf_8(path, path.read_bytes())
    head, body, first_line = _split_header(raw)
    header = _header(head)
    try:
        values = _parse(path, body, first_line)
    except InputError as error:
        rows = [line.strip() for line in body.splitlines() if line.strip()][:_SHOWN_ROWS]
        shown = " | ".join(repr(row.decode("latin-1")[:_SHOWN_CHARACTERS]) for row in rows)
        raise InputError(str(error), hint=f"the first rows are {shown}" if rows else "") from error
    factor = float(header[_TO_METRES]) if _NUMBER.fullmatch(header.get(_TO_METRES, "").encode()) else None
    return [
        Channel(
            name=_first(header, _CHANNELS) or "height",
            shape=(values.shape[0], values.shape[1]),
            unit=header.get("Value units") if factor is None else "m",
            size_um=_size_um(header, values.shape),
            load=lambda: (values if factor is None else values * factor, None),
            header=header,
        )
    ]


def _in_utf_8(path: Path, raw: bytes) -> bytes:
    if not raw.startswith(_UTF_16):
        return raw.removeprefix(b"\xef\xbb\xbf")
    try:
        return raw.decode("utf-16").encode()
    except UnicodeDecodeError as error:
        raise InputError(
            f"cannot read {path} as UTF-16", got=error.reason, hint="the file may be truncated"
        ) from error


def _split_header(raw: bytes) -> tuple[list[bytes], bytes, int]:
    """Lines above the numbers, the rest, and the number of the first line of the rest.

    A line of words counts as header only if less than half of its cells are numbers: otherwise it is a
    damaged row, which must not be passed over.
    """
    header: list[bytes] = []
    start = 0
    while start < len(raw) and len(header) < _MOST_HEADER_LINES:
        end = raw.find(b"\n", start)
        end = len(raw) if end < 0 else end + 1
        line = raw[start:end]
        if line.strip() and not line.startswith(_COMMENT):
            cells = _cells(line)
            if 2 * sum(_NUMBER.fullmatch(cell) is not None for cell in cells) >= len(cells):
                break
        header.append(line)
        start = end
    return header, raw[start:], len(header) + 1


def _cells(line: bytes) -> list[bytes]:
    return re.split(rb"[\s;]+|,\s*", line.strip(b" \t\r\n,;"))


def _header(lines: list[bytes]) -> dict[str, str]:
    header = {}
    for index, line in enumerate(lines):
        text = line.decode("utf-8", errors="replace").strip("#%; \t\r\n")
        sign = _ASSIGNMENT.search(text)
        key = text[: sign.start()].strip() if sign else ""
        if sign and _KEY.fullmatch(key):
            header[key] = text[sign.end() :].lstrip()
        elif text:
            header[f"comment {index + 1}"] = text
    return header


def _first(header: dict[str, str], names: tuple[str, ...]) -> str:
    return next((header[name] for name in names if name in header), "")


def _size_um(header: dict[str, str], shape: tuple[int, ...]) -> tuple[float, float] | None:
    """From the two sides, or from the size of a pixel."""
    if pitch := _length_um(header.get("pixel size", "")):
        return shape[0] * pitch, shape[1] * pitch
    sides = [_length_um(_first(header, names)) for names in (_HEIGHTS, _WIDTHS)]
    return (sides[0], sides[1]) if sides[0] and sides[1] else None


def _length_um(text: str) -> float | None:
    number = _LEADING_NUMBER.match(text := text.strip())
    unit = text[number.end() :].strip() if number else ""
    if number is None or not is_length(unit):
        return None
    try:
        return float(number[0].replace(",", ".")) * um_per(unit)
    except ValueError:
        return None


def _parse(path: Path, body: bytes, first_line: int) -> np.ndarray:
    if strange := body.translate(None, _TEXT_BYTES):
        position = body.index(strange[:1])
        line = first_line + body.count(b"\n", 0, position)
        raise InputError(f"{path} line {line}", got=f"byte 0x{strange[0]:02x}", wanted="a text of numbers")
    if not body.strip():
        raise InputError(f"{path} holds no numbers", wanted="one line per row of the height map")
    # Looking for a comma first takes a hundredth of the time of the regular expression.
    if (b"," in body or b";" in body) and (empty := _EMPTY_CELL.search(body)):
        line = first_line + body.count(b"\n", 0, empty.start())
        raise InputError(
            f"{path} line {line}", got="an empty cell", wanted="a number, or nan where not measured"
        )
    cells = _separate_by_blanks(path, body, first_line)
    if b"d" in cells or b"D" in cells:
        cells = _FORTRAN_EXPONENT.sub(b"e", cells)
    _refuse_cut_number(path, cells, first_line)
    try:
        values = np.loadtxt(io.BytesIO(cells), dtype=np.float64, comments=None, ndmin=2)
    except ValueError:
        _complain(path, cells, first_line)
    if np.isinf(values).any():
        _refuse_overflow(path, cells, first_line)
    return values


def _separate_by_blanks(path: Path, body: bytes, first_line: int) -> bytes:
    """Turn separators into blanks and a decimal comma into a point.

    Commas separate cells only if nothing else does; otherwise they are decimal commas, and then there is no
    decimal point in the file.

    Raises:
        InputError: cells apart by commas and by something else, as in ``1,234.5;2,345.6``.
    """
    if b"," not in body:
        return body.translate(bytes.maketrans(b";\x0c", b"  "))
    plain = _AROUND_COMMA.sub(b",", body)
    if not _OTHER_SEPARATOR.search(plain):
        return body.translate(bytes.maketrans(b",\x0c", b"  "))
    if b"." in plain or plain != body:
        for line, row in enumerate(plain.splitlines(), start=first_line):
            if b"," in row and _OTHER_SEPARATOR.search(row.strip()):
                got = repr(row.strip().decode("ascii")[:_SHOWN_CHARACTERS])
                wanted = "cells apart by one separator, and no marks of thousands"
                raise InputError(f"{path} line {line}", got=got, wanted=wanted)
    return body.translate(bytes.maketrans(b",;\x0c", b".  "))


def _refuse_cut_number(path: Path, cells: bytes, first_line: int) -> None:
    """A copy cut off inside the last number (5.4e-007 -> 5.4) would otherwise read as 5.4 m."""
    if cells.endswith((b"\n", b"\r")):
        return
    last_row = cells[cells.rfind(b"\n") + 1 :].decode("ascii").split()
    if len(last_row) < 2:
        return
    before, last = _EXPONENT.search(last_row[-2]), _EXPONENT.search(last_row[-1])
    if before is not None and (last is None or len(last[0]) < len(before[0])):
        line = first_line + cells.count(b"\n")
        raise InputError(
            f"{path} line {line} ends inside a number",
            got=repr(last_row[-1]),
            wanted=f"a number spelt like {last_row[-2]!r}",
            hint="the file may be truncated",
        )


def _complain(path: Path, cells: bytes, first_line: int) -> NoReturn:
    """Find the first bad line; only called after the fast parser refused the text."""
    width, width_line = 0, 0
    for line, row in enumerate(cells.decode("ascii").splitlines(), start=first_line):
        tokens = row.split()
        for token in tokens:
            if not _is_number(token):
                raise InputError(f"{path} line {line}", got=repr(token[:24]), wanted="a number")
        if tokens and width and len(tokens) != width:
            raise InputError(
                f"{path} line {line}",
                got=f"{len(tokens)} values",
                wanted=f"{width} values as in line {width_line}",
                hint="the file may be truncated",
            )
        if tokens and not width:
            width, width_line = len(tokens), line
    raise InputError(f"{path} is no matrix of numbers", wanted="one line per row, cells apart by tabs")


def _refuse_overflow(path: Path, cells: bytes, first_line: int) -> None:
    """An infinity that is not written as one is a number too large to hold, such as 1e400."""
    for line, row in enumerate(cells.decode("ascii").splitlines(), start=first_line):
        for token in row.split():
            if "inf" not in token.lower() and np.isinf(float(token)):
                raise InputError(f"{path} line {line}", got=repr(token[:24]), wanted="a number below 1e308")


def _is_number(token: str) -> bool:
    try:
        float(token)
    except ValueError:
        return False
    # Python alone takes 1_000 for a number.
    return "_" not in token


def write_text_matrix(path: str | Path, height_um: np.ndarray) -> None:
    """Write heights with five significant digits, one line per row.

    Args:
        height_um: finite heights below 10 m, µm, shape (ny, nx).

    Raises:
        InputError: a value that the format cannot hold.
    """
    if not np.isfinite(height_um).all():
        raise InputError("height in a text matrix", got="NaN or infinity", wanted="finite numbers")
    mantissa, exponent = _five_digits(np.abs(height_um) * 1e-6)
    text = np.empty((*height_um.shape, _CELL_WIDTH + 1), np.uint8)
    text[:] = np.frombuffer(b"-0.0000e-000\t\n", np.uint8)
    for place, power in zip((1, 3, 4, 5, 6), (10000, 1000, 100, 10, 1), strict=True):
        text[..., place] = ord("0") + mantissa // power % 10
    text[..., 8] = np.where(exponent < 0, ord("-"), ord("+"))
    for place, power in zip((9, 10, 11), (100, 10, 1), strict=True):
        text[..., place] = ord("0") + np.abs(exponent) // power % 10
    text[:, -1, 12] = ord("\r")
    keep = np.ones(text.shape, bool)
    keep[..., 0] = height_um < 0
    keep[:, :-1, 13] = False
    Path(path).write_bytes(text[keep].tobytes())


def _five_digits(magnitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(integer mantissa 10000…99999, decimal exponent); zero has mantissa and exponent 0."""
    positive = magnitude > 0
    exponent = np.floor(np.log10(magnitude, where=positive, out=np.zeros_like(magnitude))).astype(int)
    mantissa = np.rint(magnitude * 10.0 ** (4 - exponent)).astype(int)
    carried = mantissa >= 100000
    return np.where(carried, 10000, mantissa), np.where(positive, exponent + carried, 0)


def _recognises(path: Path, head: bytes) -> bool:
    """Whether the file is text with rows of numbers.

    Raises:
        InputError: the rows are points of a profile or of a cloud.
    """
    if head.startswith(_UTF_16):
        head = head[: len(head) // 2 * 2].decode("utf-16", errors="ignore").encode()
    lines, body, _ = _split_header(head.removeprefix(b"\xef\xbb\xbf"))
    if len(lines) == _MOST_HEADER_LINES or b"\0" in b"".join(lines):
        return False
    rows = [_cells(line) for line in body.splitlines() if line.strip()]
    if not rows or len(rows[0]) < 2 or _NUMBER.fullmatch(rows[0][0]) is None:
        return False
    columns = len(rows[0])
    if columns <= _POINT_COLUMNS and len(rows) >= _POINT_ROWS_PER_COLUMN * columns:
        raise InputError(
            f"{path} holds {'a profile' if columns == 2 else 'a point cloud'}",
            got=f"{columns} numbers in a row, the first {b' '.join(rows[0]).decode('latin-1')}",
            wanted="a height map",
            hint="format 'text-matrix' reads it as a map",
        )
    return True


READER = Reader("text-matrix", _recognises, read_channels, self_describing=False)
