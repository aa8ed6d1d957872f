"""Gwyddion Simple Field: a text header, NUL padding to four bytes, little-endian float32 rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import is_length, um_per
from litho_data.readers.channel import Channel

_MAGIC = b"Gwyddion Simple Field 1.0\n"
_ITEM = 4


def read_channels(path: Path) -> list[Channel]:
    """The one field of a GSF file; unit and size only where the header states them.

    Raises:
        InputError: another format, a header without XRes and YRes, or data of another length.
    """
    raw = path.read_bytes()
    if not raw.startswith(_MAGIC):
        raise InputError(f"{path} is no Gwyddion Simple Field", got=repr(raw[:25]), wanted=repr(_MAGIC))
    header_end = raw.find(b"\0")
    header = _parse_header(path, raw[len(_MAGIC) : header_end if header_end >= 0 else None])
    shape = (_count(path, header, "YRes"), _count(path, header, "XRes"))
    # At least one NUL, even where the header already ends on a multiple of four.
    start = (header_end // _ITEM + 1) * _ITEM
    wanted = shape[0] * shape[1] * _ITEM
    if header_end < 0 or len(raw) - start != wanted:
        raise InputError(
            f"{path}: bytes of data",
            got=0 if header_end < 0 else len(raw) - start,
            wanted=f"{wanted} for {shape[0]} x {shape[1]} pixels",
            hint="the file may be truncated",
        )
    values = np.frombuffer(raw, dtype="<f4", offset=start).reshape(shape)
    return [
        Channel(
            name=header.get("Title", "field"),
            shape=shape,
            unit=header.get("ZUnits"),
            size_um=_size_um(header),
            load=lambda: (values, None),
            header=header,
        )
    ]


def _parse_header(path: Path, text: bytes) -> dict[str, str]:
    header = {}
    for number, line in enumerate(text.decode("utf-8", errors="replace").splitlines(), start=2):
        key, equals, value = line.partition("=")
        if line.strip() and not equals:
            raise InputError(f"{path} line {number}", got=repr(line[:40]), wanted="name = value")
        if equals:
            header[key.strip()] = value.strip()
    return header


def _count(path: Path, header: dict[str, str], key: str) -> int:
    text = header.get(key)
    if text is None or not text.isascii() or not text.isdigit() or len(text) > 9:
        raise InputError(f"{path}: {key}", got=text, wanted="a number of pixels")
    return int(text)


def _size_um(header: dict[str, str]) -> tuple[float, float] | None:
    unit = header.get("XYUnits", "")
    if not is_length(unit):
        return None
    try:
        size = float(header["YReal"]) * um_per(unit), float(header["XReal"]) * um_per(unit)
    except (KeyError, ValueError):
        return None
    return size if all(np.isfinite(size)) and min(size) > 0 else None
