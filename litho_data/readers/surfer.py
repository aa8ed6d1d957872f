"""Read grids of Golden Software's Surfer, in the formats DSAA (text), DSBB (Surfer 6) and DSRB (Surfer 7).
The rows in these files run from bottom to top.
"""

import struct
from pathlib import Path

import numpy as np

from litho_data.foundation import Array, InputError
from litho_data.readers.reader import Channel, Reader, in_memory

_MAGIC = (b"DSAA", b"DSBB", b"DSRB")
# Pixels with at least this value are blank (not measured). The mark in text files and in files with float32
# is 1.70141e38, which is slightly larger.
_BLANK = 1.7014e38


def read_channels(path: Path) -> list[Channel]:
    """Return the only channel of the file, which is a grid of heights. The file states the coordinates of
    pixel centres, without a unit.

    Raises:
        InputError: the file is not a Surfer grid.
    """
    raw = path.read_bytes()
    if not raw.startswith(_MAGIC):
        raise InputError("not a Surfer grid", got=repr(raw[:4]), wanted="DSAA, DSBB or DSRB")
    values, step_y, step_x, blank = _sections(raw) if raw.startswith(b"DSRB") else _older(raw)
    values = np.where(values >= blank, np.nan, values)[::-1]
    extent = step_y * values.shape[0], step_x * values.shape[1]
    return [Channel("grid", values.shape, unit=None, size_um=None, load=in_memory(values), extent=extent)]


def _older(raw: bytes) -> tuple[Array, float, float, float]:
    """Read a DSAA or DSBB file. Return the heights, the steps along y and x, and the value that marks blank
    pixels.

    The file contains, in this order, the numbers of columns and rows, the ranges of x, y and z, and the
    heights.
    """
    if raw.startswith(b"DSAA"):
        numbers = np.array(raw.split()[1:], dtype=float)
        nx, ny, x_low, x_high, y_low, y_high, *_ = numbers[:8].tolist()
        values = numbers[8:]
    else:
        nx, ny, x_low, x_high, y_low, y_high, *_ = struct.unpack_from("<2h6d", raw, 4)
        values = np.frombuffer(raw, "<f4", offset=56).astype(float)
    steps = (y_high - y_low) / (ny - 1), (x_high - x_low) / (nx - 1)
    return values.reshape(int(ny), int(nx)), *steps, _BLANK


def _sections(raw: bytes) -> tuple[Array, float, float, float]:
    """Read a DSRB file. Return the heights, the steps along y and x, and the value that marks blank pixels.

    The file consists of sections, each with a tag, a size and a content. The section GRID contains the
    geometry, and the section DATA after it contains the heights.
    """
    position = 0
    ny = nx = step_x = step_y = blank = 0
    while True:
        tag, size = struct.unpack_from("<4si", raw, position)
        position += 8
        if tag == b"GRID":
            ny, nx, _, _, step_x, step_y, _, _, _, blank = struct.unpack_from("<2i8d", raw, position)
        elif tag == b"DATA":
            return np.frombuffer(raw, "<f8", nx * ny, position).reshape(ny, nx), step_y, step_x, blank
        position += max(size, 0)


READER = Reader("surfer", lambda path, head: head.startswith(_MAGIC), read_channels)
