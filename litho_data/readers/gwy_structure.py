"""Whether the bytes of a GWY file form a tree of components whose sizes fit into each other.

gwyfile trusts the sizes in the file: a missing string end or a damaged count sends it into an
endless loop, so they are checked before it sees the file.
"""

from __future__ import annotations

import struct
from pathlib import Path

from litho_data.foundation.errors import InputError

_MAGIC = b"GWYP"
_SCALAR_BYTES = {"b": 1, "c": 1, "i": 4, "q": 8, "d": 8}
_ITEM_BYTES = {"C": 1, "I": 4, "Q": 8, "D": 8}


def check_structure(path: Path) -> None:
    """Accept a well-formed file.

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
