"""Read the levels from GDSII files that the design package wrote, one band of rows at a time.

Such a file describes the layout by rectangles, which are grouped in cells. A cell may be placed at several
positions.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from litho_data.foundation import Array, Shape

_UNIT_M, _PRECISION_M = 1e-6, 1e-9
# Side of the blocks into which the design package divides a layout, in px.
_BLOCK_PX = 128
# Number of rectangles that are read at once.
_CHUNK = 1 << 10
_CELL_NAME, _REFERENCE_NAME, _PLACE, _END_LIBRARY = 0x0606, 0x1206, 0x1003, 0x0400

# One rectangle consists of these records, one after the other: BOUNDARY, LAYER, DATATYPE 0, XY with five
# corners, and ENDEL.
_RECTANGLE = np.dtype(
    [
        ("start", ">u8"),
        ("layer", ">i2"),
        ("type", "S6"),
        ("xy", ">u4"),
        ("corners", ">i4", (5, 2)),
        ("end", ">u4"),
    ]
)
_START = 0x0004080000060D02


class GdsRows:
    """The levels of a GDS file, as uint8 with row 0 at the top. Slicing the object by rows reads only the
    requested rows.
    """

    def __init__(self, path: Path, shape: Shape, pitch_um: float, layers: str):
        self.shape = shape
        self._step, self._layers = pitch_um * _UNIT_M / _PRECISION_M, layers
        self._path = path
        self._shapes: dict[str, tuple[int, int]] = {}
        self._references: dict[str, list[tuple[str, int, int]]] = {}
        self._index()
        # For every row of blocks, the position (x, y) of its lower left corner in pixels, and the name of its
        # cell.
        self._bands = [
            (round((x + dx) / self._step), round((y + dy) / self._step), cell)
            for name, x, y in self._references["LAYOUT"]
            for cell, dx, dy in self._references[name]
        ]

    def __getitem__(self, rows: slice) -> Array:
        top, bottom, _ = rows.indices(self.shape[0])
        low, high = self.shape[0] - bottom, self.shape[0] - top
        # A rectangle is the sum of four quadrants, one for each corner. A quadrant adds or subtracts the
        # level everywhere above and to the right of its corner. The cumulative sums over rows and columns add
        # all quadrants at once.
        steps = np.zeros((bottom - top + 1, self.shape[1] + 1), np.int16)
        for x0, y0, cell in self._bands:
            if y0 < high and y0 + _BLOCK_PX > low:
                for name, dx, _ in self._references[cell]:
                    start, count = self._shapes[name]
                    shapes = np.fromfile(self._path, _RECTANGLE, count, offset=start)
                    corners = np.rint(shapes["corners"][:, [0, 2]] / self._step).astype(np.intp)
                    x = corners[..., 0] + (x0 + round(dx / self._step))
                    y = np.clip(corners[..., 1] + y0, low, high) - low
                    weight = shapes["layer"].astype(np.int16) if self._layers == "exclusive" else np.int16(1)
                    for one, other in ((0, 0), (0, 1), (1, 0), (1, 1)):
                        np.add.at(steps, (y[:, one], x[:, other]), weight if one == other else -weight)
        summed = steps.cumsum(0, dtype=np.int16).cumsum(1, dtype=np.int16)
        return summed[-2::-1, :-1].astype(np.uint8)

    def _index(self) -> None:
        """For every cell, find where its rectangles are stored in the file, and which other cells it
        contains.
        """
        at, cell, name = 0, "", ""
        while True:
            # The records that are evaluated here fit in 64 bytes. The records of rectangles are skipped.
            part = np.fromfile(self._path, np.uint8, 64, offset=at).tobytes()
            length, kind = struct.unpack(">HH", part[:4])
            body = part[4:length]
            if kind == _CELL_NAME:
                cell = body.rstrip(b"\0").decode()
                count = self._shapes_from(at + length)
                self._shapes[cell], self._references[cell] = (at + length, count), []
                at += count * _RECTANGLE.itemsize
            if kind == _REFERENCE_NAME:
                name = body.rstrip(b"\0").decode()
            elif kind == _PLACE:
                self._references[cell].append((name, *struct.unpack(">ii", body)))
            elif kind == _END_LIBRARY:
                return
            at += length

    def _shapes_from(self, at: int) -> int:
        """Return the number of rectangles that follow one another in the file from byte ``at`` on."""
        count = 0
        while True:
            start = at + count * _RECTANGLE.itemsize
            part = np.fromfile(self._path, _RECTANGLE, _CHUNK, offset=start)
            other = np.flatnonzero(part["start"] != _START)
            if other.size or len(part) < _CHUNK:
                return count + (int(other[0]) if other.size else len(part))
            count += len(part)
