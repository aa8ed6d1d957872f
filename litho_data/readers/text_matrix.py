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
_LENGTH = re.compile(r"^\s*([-+\d.eE]+)\s*(\S+)\s*$")
_COMMENT = b"#"
_NUMBER = re.compile(rb"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?nan", re.IGNORECASE)
_CELL_WIDTH = len("-1.2345e-007\t")


def read_channels(path: Path) -> list[Channel]:
    """The one channel of a text matrix; unit and size only if comment lines of Gwyddion state them.

    Comment lines start with ``#``. A decimal comma is accepted if the cells are not separated by
    commas. ``nan`` marks a pixel that was not measured.

    Raises:
        InputError: binary or empty file, something that is no number, rows of different lengths,
            or a last number that was cut off; the message names the line.
    """
    raw = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    comments, body, first_line = _split_comments(raw)
    header = _header(comments)
    values = _parse(path, body, first_line)
    return [
        Channel(
            name=header.get("Channel", "height"),
            shape=(values.shape[0], values.shape[1]),
            unit=header.get("Value units"),
            size_um=_size_um(header),
            load=lambda: (values, None),
            header=header,
        )
    ]


def _split_comments(raw: bytes) -> tuple[list[bytes], bytes, int]:
    """Comment lines on top, the rest, and the number of the first line of the rest."""
    comments = []
    start = 0
    while raw.startswith(_COMMENT, start):
        end = raw.find(b"\n", start)
        end = len(raw) if end < 0 else end + 1
        comments.append(raw[start:end])
        start = end
    return comments, raw[start:], len(comments) + 1


def _header(comments: list[bytes]) -> dict[str, str]:
    header = {}
    for index, line in enumerate(comments):
        text = line.decode("utf-8", errors="replace").strip("# \t\r\n")
        key, colon, value = text.partition(":")
        header[key.strip() if colon else f"comment {index + 1}"] = value.strip() if colon else text
    return header


def _size_um(header: dict[str, str]) -> tuple[float, float] | None:
    sizes = []
    for key in ("Height", "Width"):
        match = _LENGTH.match(header.get(key, ""))
        if match is None or not is_length(match[2]):
            return None
        try:
            sizes.append(float(match[1]) * um_per(match[2]))
        except ValueError:
            return None
    return sizes[0], sizes[1]


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
    cells = _separate_by_blanks(body)
    _refuse_cut_number(path, cells, first_line)
    try:
        values = np.loadtxt(io.BytesIO(cells), dtype=np.float64, comments=None, ndmin=2)
    except ValueError:
        _complain(path, cells, first_line)
    return values


def _separate_by_blanks(body: bytes) -> bytes:
    """Turn separators into blanks and a decimal comma into a point."""
    first = body.lstrip().split(b"\n", 1)[0].strip()
    apart_by_other = any(mark in first for mark in (b";", b"\t", b" "))
    decimal_comma = b"," in first and b"." not in first and apart_by_other and not re.search(rb",\s", first)
    return body.translate(bytes.maketrans(b",;\x0c", b".  " if decimal_comma else b"   "))


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


def _starts_with_numbers(head: bytes) -> bool:
    for line in head.removeprefix(b"\xef\xbb\xbf").splitlines():
        if line.strip() and not line.startswith(b"#"):
            cells = re.split(rb"[\s;]+|,\s*", line.strip(b" \t,;"))
            return len(cells) > 1 and _NUMBER.fullmatch(cells[0]) is not None
    return False


READER = Reader(
    "text-matrix", lambda path, head: _starts_with_numbers(head), read_channels, self_describing=False
)
