"""Read files in Gwyddion's own format, GWY. Every data field becomes a channel, and its mask is kept."""

import re
import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation import Array, InputError, Shape
from litho_data.readers.reader import Channel, Loaded, Reader, extent_um, one_by_one

_MAGIC = b"GWYP"
# The types of single values, keyed by the letter that stands for them in the file. A capital letter stands
# for an array of this type.
_NUMBERS = {"b": "?", "c": "u1", "i": "<i4", "q": "<i8", "d": "<f8"}
_FIELD_KEY = re.compile(r"/(\d+)/data")


def read_channels(path: Path) -> list[Channel]:
    """Return one channel per data field. Masked pixels keep their heights, and the channel's ``load`` returns
    the mask in addition to the heights.

    A pixel is masked if Gwyddion's mask is above zero there. The metadata that Gwyddion stores for a channel
    become the channel's header.

    Raises:
        InputError: the file is not a Gwyddion file.
    """
    data = path.read_bytes()
    if not data.startswith(_MAGIC):
        raise InputError("not a Gwyddion file", got=repr(data[:4]), wanted=repr(_MAGIC))
    content, end = _object(data, len(_MAGIC), len(data))
    if end != len(data):
        raise EOFError(f"{len(data)} bytes instead of {end}")
    numbers = sorted(
        (found[1] for key in content if (found := _FIELD_KEY.fullmatch(key))), key=lambda one: (len(one), one)
    )
    titles = [str(content.get(f"/{number}/data/title", f"channel {number}")) for number in numbers]
    return [
        one_by_one(title, partial(_channel, content, number, title))
        for number, title in zip(numbers, titles, strict=True)
    ]


def _channel(content: dict[str, Any], number: str, title: str) -> Channel:
    field, mask = content[f"/{number}/data"], content.get(f"/{number}/mask")
    shape = (int(field["yres"]), int(field["xres"]))
    return Channel(
        name=title,
        shape=shape,
        unit=_unit(field, "si_unit_z"),
        size_um=extent_um(field.get("yreal", 0), field.get("xreal", 0), _unit(field, "si_unit_xy")),
        load=partial(_load, title, field, mask, shape),
        header={key: str(value) for key, value in content.get(f"/{number}/meta", {}).items()},
    )


def _load(what: str, field: dict[str, Any], mask: dict[str, Any] | None, shape: Shape) -> Loaded:
    heights = _pixels(f"{what}: values", field, shape)
    return heights, None if mask is None else _pixels(f"{what}: values of the mask", mask, shape) > 0


def _pixels(what: str, field: dict[str, Any], shape: Shape) -> Array:
    values = np.array(field["data"], dtype=float)
    if values.size != shape[0] * shape[1]:
        raise InputError(what, got=values.size, wanted=f"{shape[0]} x {shape[1]}")
    return values.reshape(shape)


def _unit(field: dict[str, Any], key: str) -> str | None:
    """Return the unit that a data field states, or None if this unit is empty. Gwyddion writes an empty unit
    for pure numbers.
    """
    return str(field.get(key, {}).get("unitstr", "")) or None


def _object(data: bytes, start: int, limit: int) -> tuple[dict[str, Any], int]:
    """Return the components of an object, keyed by name, and the position where the object ends.

    Args:
        data: the bytes of the file.
        start: position where the object starts.
        limit: position that the object must not exceed.

    Raises:
        EOFError, struct.error: a size that the file states exceeds the file or the enclosing object.
    """
    _, at = _text(data, start, limit)
    end, at = at + 4 + _count(data, at), at + 4
    if end > limit:
        raise EOFError(f"an object at {start} reaches beyond its end")
    found: dict[str, Any] = {}
    while at < end:
        name, at = _text(data, at, end)
        found[name], at = _component(data, chr(data[at]) if at < end else "the end", at + 1, end)
    return found, end


def _component(data: bytes, kind: str, at: int, limit: int) -> tuple[Any, int]:
    if kind == "s":
        return _text(data, at, limit)
    if kind == "o":
        return _object(data, at, limit)
    count = 1 if kind.islower() else _count(data, at)
    at += 0 if kind.islower() else 4
    if kind in ("S", "O"):
        parts = []
        for _ in range(count):
            part, at = _component(data, kind.lower(), at, limit)
            parts.append(part)
        return parts, at
    if kind.lower() not in _NUMBERS:
        raise EOFError(f"{kind!r} at {at} is not a type of component")
    form = np.dtype(_NUMBERS[kind.lower()])
    if at + count * form.itemsize > limit:
        raise EOFError(f"a component at {at} reaches beyond its end")
    values = np.frombuffer(data, form, count, at)
    return values[0] if kind.islower() else values, at + count * form.itemsize


def _count(data: bytes, at: int) -> int:
    return int(struct.unpack_from("<I", data, at)[0])


def _text(data: bytes, start: int, limit: int) -> tuple[str, int]:
    """Return the text from ``start`` to the next NUL, and the position after that NUL."""
    end = data.find(b"\0", start, limit)
    if end < 0:
        raise EOFError(f"a string at {start} does not end")
    return data[start:end].decode("utf-8", errors="replace"), end + 1


READER = Reader("gwy", lambda path, head: head.startswith(_MAGIC), read_channels)
