"""Gwyddion's own files: every data field is a channel, a mask stays a mask."""

import re
import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array, Shape
from litho_data.readers.confined import confined
from litho_data.readers.reader import (
    Channel,
    Loaded,
    Reader,
    extent_um,
    foreign_parser,
    one_by_one,
)

_MAGIC = b"GWYP"
_SCALAR_BYTES = {"b": 1, "c": 1, "i": 4, "q": 8, "d": 8}
_ITEM_BYTES = {"C": 1, "I": 4, "Q": 8, "D": 8}
_FIELD_KEY = re.compile(r"/(\d+)/data")


def read_channels(path: Path) -> list[Channel]:
    """One channel per data field; heights under a mask are kept, together with the mask.

    A pixel counts as masked where the mask is above zero. The metadata that Gwyddion keeps for a
    channel is its header.

    Raises:
        InputError: damaged file, or a field whose data do not fit its size.
    """
    import gwyfile

    check_structure(path)
    with foreign_parser(path, "GWY"):
        container = gwyfile.load(str(path))
        keys = sorted(
            (key for key in container if _FIELD_KEY.fullmatch(key)), key=lambda key: int(key.split("/")[1])
        )
        titles = [str(container.get(f"{key}/title", f"channel {key.split('/')[1]}")) for key in keys]
        return [
            one_by_one(path, "GWY", title, partial(_channel, path, container, key, title))
            for key, title in zip(keys, titles, strict=True)
        ]


def _channel(path: Path, container: Any, key: str, title: str) -> Channel:
    number = key.split("/")[1]
    field = container[key]
    shape = (int(field["yres"]), int(field["xres"]))
    return Channel(
        name=title,
        shape=shape,
        unit=_unit(field, "si_unit_z"),
        size_um=extent_um(field.get("yreal", 0), field.get("xreal", 0), _unit(field, "si_unit_xy")),
        load=partial(_load, path, key, shape),
        header={str(key): str(value) for key, value in (container.get(f"/{number}/meta") or {}).items()},
    )


def _load(path: Path, key: str, shape: Shape) -> Loaded:
    import gwyfile

    with foreign_parser(path, "GWY"):
        container = gwyfile.load(str(path))
        mask_key = key.replace("/data", "/mask")
        mask = container.get(mask_key)
        return (
            _pixels(path, key, container[key], shape),
            None if mask is None else _pixels(path, mask_key, mask, shape) > 0,
        )


def _pixels(path: Path, key: str, field: Any, shape: Shape) -> Array:
    data = np.asarray(field["data"], dtype=float)
    if data.size != shape[0] * shape[1]:
        raise InputError(f"{path} {key}: values", got=data.size, wanted=f"{shape[0]} x {shape[1]}")
    return data.reshape(shape)


def _unit(field: Any, key: str) -> str | None:
    """None if Gwyddion states no unit, as it does for pure numbers."""
    unit = field.get(key)
    return None if unit is None else str(unit.get("unitstr", "")) or None


def check_structure(path: Path) -> None:
    """Accept a file whose bytes form a tree of components with sizes that fit into each other.

    gwyfile trusts the sizes in the file. A missing end of a string or a damaged count sends it into an
    endless loop, so sizes are checked first.

    Raises:
        InputError: another format, or sizes that do not fit; the message gives the position.
    """
    data = path.read_bytes()
    if not data.startswith(_MAGIC):
        raise InputError(f"{path} is no Gwyddion file", got=repr(data[:4]), wanted=repr(_MAGIC))
    try:
        end = _object_end(data, len(_MAGIC), len(data))
    except (ValueError, struct.error, RecursionError) as error:
        raise InputError(
            f"{path} is damaged", got=str(error), wanted="a tree of Gwyddion components"
        ) from error
    if end != len(data):
        raise InputError(f"{path} is damaged: bytes", got=len(data), wanted=end)


def _object_end(data: bytes, start: int, limit: int) -> int:
    position = _string_end(data, start, limit)
    (size,) = struct.unpack_from("<I", data, position)
    position, end = position + 4, position + 4 + size
    if end > limit:
        raise ValueError(f"an object of {size} bytes at {start} reaches beyond its end")
    while position < end:
        position = _component_end(data, position, end)
    return end


def _component_end(data: bytes, start: int, limit: int) -> int:
    position = _string_end(data, start, limit)
    kind = chr(data[position]) if position < limit else "the end"
    position += 1
    if kind in _SCALAR_BYTES:
        end = position + _SCALAR_BYTES[kind]
    elif kind in _ITEM_BYTES:
        end = position + 4 + _ITEM_BYTES[kind] * struct.unpack_from("<I", data, position)[0]
    elif kind == "s":
        end = _string_end(data, position, limit)
    elif kind == "o":
        end = _object_end(data, position, limit)
    elif kind in ("S", "O"):
        (count,) = struct.unpack_from("<I", data, position)
        end = position + 4
        for _ in range(count):
            end = (_string_end if kind == "S" else _object_end)(data, end, limit)
    else:
        raise ValueError(f"{kind!r} at {start} is no type of component")
    if end > limit:
        raise ValueError(f"a component at {start} reaches beyond its end")
    return end


def _string_end(data: bytes, start: int, limit: int) -> int:
    """Position after the closing NUL."""
    end = data.find(b"\0", start, limit)
    if end < 0:
        raise ValueError(f"a string at {start} does not end")
    return end + 1


READER = Reader("gwy", lambda path, head: head.startswith(_MAGIC), confined(read_channels, ("gwyfile",)))
