"""Read Golden Software's Surfer grids: DSAA (text), DSBB (Surfer 6) and DSRB (Surfer 7), y upwards."""

import struct
from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.readers.reader import DAMAGED, Channel, Reader, in_memory

_MAGIC = (b"DSAA", b"DSBB", b"DSRB")
# The blank value as float32, and as written with six digits.
_BLANK = 1.7014e38
_GRID = struct.Struct("<2i8d")


def read_channels(path: Path) -> list[Channel]:
    """Read the one grid; its coordinates are those of the pixel centres, in a unit that the file does not
    state.

    Raises:
        InputError: a damaged file.
    """
    raw = path.read_bytes()
    read = {b"DSAA": _text, b"DSBB": _binary_6, b"DSRB": _binary_7}.get(raw[:4])
    if read is None:
        raise InputError(f"{path} is no Surfer grid", got=repr(raw[:4]), wanted="DSAA, DSBB or DSRB")
    try:
        values, step_y, step_x, blank = read(raw)
    except (ValueError, struct.error, IndexError, ZeroDivisionError) as error:
        raise InputError(f"cannot read {path} as a Surfer grid", got=error, hint=DAMAGED) from error
    values = np.where(values >= blank, np.nan, values)[::-1]
    return [
        Channel(
            name="grid",
            shape=values.shape,
            unit=None,
            size_um=None,
            load=in_memory(values),
            extent=(step_y * values.shape[0], step_x * values.shape[1]),
        )
    ]


def _text(raw: bytes) -> tuple[Array, float, float, float]:
    cells = raw.decode("ascii").split()
    nx, ny = int(cells[1]), int(cells[2])
    x_low, x_high, y_low, y_high = (float(one) for one in cells[3:7])
    values = np.array(cells[9:], dtype=float).reshape(ny, nx)
    return values, (y_high - y_low) / (ny - 1), (x_high - x_low) / (nx - 1), _BLANK


def _binary_6(raw: bytes) -> tuple[Array, float, float, float]:
    nx, ny, x_low, x_high, y_low, y_high, _, _ = struct.unpack_from("<2h6d", raw, 4)
    values = np.frombuffer(raw, "<f4", offset=56).reshape(ny, nx).astype(float)
    return values, (y_high - y_low) / (ny - 1), (x_high - x_low) / (nx - 1), _BLANK


def _binary_7(raw: bytes) -> tuple[Array, float, float, float]:
    """Read sections of tag, size and content: GRID contains the geometry, and DATA after it the heights."""
    position, grid = 0, None
    while position < len(raw):
        tag, size = struct.unpack_from("<4si", raw, position)
        position += 8
        if tag == b"GRID":
            grid = _GRID.unpack_from(raw, position)
        elif tag == b"DATA" and grid is not None:
            ny, nx, _, _, step_x, step_y, _, _, _, blank = grid
            return np.frombuffer(raw, "<f8", nx * ny, position).reshape(ny, nx), step_y, step_x, blank
        if size < 0:
            break
        position += size
    raise ValueError("no GRID and DATA")


READER = Reader("surfer", lambda path, head: head.startswith(_MAGIC), read_channels)
