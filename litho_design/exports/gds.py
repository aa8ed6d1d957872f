"""Layouts as GDSII, one layer per level in cells that repeat, written and read a band of rows at a time."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from litho_design.exports.rows import LevelRows

_UNIT_M = 1e-6
_PRECISION_M = 1e-9

# Side of the blocks that a part is cut into.
_BLOCK_PX = 128
# Shapes that are read at once.
_CHUNK = 1 << 10

GdsLayers = Literal["cumulative", "exclusive"]
Box = tuple[int, int, int, int]

_CELL_NAME, _REFERENCE_NAME, _PLACE, _END_LIBRARY = 0x0606, 0x1206, 0x1003, 0x0400

# One rectangle: the records BOUNDARY, LAYER, DATATYPE 0, XY of five corners, ENDEL, one after the other.
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


def write_gds(
    path: Path,
    levels: LevelRows,
    pitch_um: float,
    layers: GdsLayers,
    parts: Mapping[str, Box] | None = None,
) -> int:
    """Write rectangles, unit 1 µm, grid 1 nm, y up; returns how many the file holds.

    Layer k holds {level >= k} (``cumulative``, k from 1) or {level == k} (``exclusive``, k from 0).
    Runs along rows are merged over equal rows below them, so every shape is a rectangle. The cell LAYOUT
    refers to one cell for every part, that to one for every 128 rows, and that to blocks of 128 pixels:
    equal blocks are one cell. Of the shapes no more than one block is in memory.

    Args:
        parts: rows from, to, columns from, to, of each part by name; the whole map is ELEMENT by default.
    """
    import gdstk

    known: dict[bytes, gdstk.Cell] = {}
    height, width = levels.shape
    drawn, layout = 0, gdstk.Cell("LAYOUT")
    # The same time for equal layouts, whose files are equal then.
    writer = gdstk.GdsWriter(path, unit=_UNIT_M, precision=_PRECISION_M, timestamp=datetime(1970, 1, 1))
    for name, (top, bottom, left, right) in (parts or {"ELEMENT": (0, height, 0, width)}).items():
        part = gdstk.Cell(name)
        for row in range(top, bottom, _BLOCK_PX):
            band = levels[row : min(row + _BLOCK_PX, bottom)][:, left:right]
            cell = gdstk.Cell(f"{name}_{row}")
            for column in range(0, right - left, _BLOCK_PX):
                block = np.ascontiguousarray(band[:, column : column + _BLOCK_PX])
                key = hashlib.blake2b(repr(block.shape).encode() + block.tobytes(), digest_size=16).digest()
                if key not in known:
                    shapes = _shapes(block, pitch_um, layers)
                    drawn += len(shapes)
                    writer.write(gdstk.Cell(f"BLOCK_{len(known)}").add(*shapes))
                    # Later blocks refer to it by its name: its shapes need not stay.
                    known[key] = gdstk.Cell(f"BLOCK_{len(known)}")
                cell.add(gdstk.Reference(known[key], (column * pitch_um, 0)))
            writer.write(cell)
            part.add(gdstk.Reference(cell, (0, (bottom - row - len(band)) * pitch_um)))
        writer.write(part)
        layout.add(gdstk.Reference(part, (left * pitch_um, (height - bottom) * pitch_um)))
    writer.write(layout)
    writer.close()
    return drawn


def _shapes(levels: np.ndarray, pitch_um: float, layers: GdsLayers) -> list[Any]:
    """The rectangles of one block, its lower left corner at 0."""
    from gdstk import rectangle

    highest = int(levels.max())
    wanted = np.arange(1, highest + 1) if layers == "cumulative" else np.arange(highest + 1)
    masks = levels >= wanted[:, None, None] if layers == "cumulative" else levels == wanted[:, None, None]
    mask, top, bottom, left, right = rectangles(masks).T
    corners = pitch_um * np.stack([left, len(levels) - bottom, right, len(levels) - top], axis=1)
    return [
        rectangle((x0, y0), (x1, y1), layer)
        for layer, (x0, y0, x1, y1) in zip(wanted[mask].tolist(), corners.tolist(), strict=True)
    ]


def rectangles(masks: np.ndarray) -> np.ndarray:
    """Disjoint rectangles that cover boolean masks (n, ny, nx): mask, top, bottom, left, right (m, 5).

    Ends are excluded.
    """
    edges = np.diff(np.pad(masks.astype(np.int8), ((0, 0), (0, 0), (1, 1))), axis=2)
    mask, row, left = np.nonzero(edges > 0)
    right = np.nonzero(edges < 0)[2]
    # Equal runs of one mask, from above to below: a rectangle goes on while no row is left out.
    order = np.lexsort([row, right, left, mask])
    mask, row, left, right = (one[order] for one in (mask, row, left, right))
    new = np.ones(len(row) + 1, bool)
    new[1:-1] = (np.diff(row) != 1) | np.any(np.diff([mask, left, right]), axis=0)
    first, last = np.flatnonzero(new[:-1]), np.flatnonzero(new[1:])
    return np.stack([mask[first], row[first], row[last] + 1, left[first], right[first]], axis=1)


class GdsRows:
    """The levels of a file of ``write_gds``, uint8, row 0 on top; only the rows asked for are read."""

    def __init__(self, path: Path, shape: tuple[int, int], pitch_um: float, layers: GdsLayers):
        self.shape = shape
        self._step, self._layers = pitch_um * _UNIT_M / _PRECISION_M, layers
        self._path = path
        self._shapes: dict[str, tuple[int, int]] = {}
        self._references: dict[str, list[tuple[str, int, int]]] = {}
        self._index()
        # Every row of blocks by its lower left corner in pixels.
        self._bands = [
            (round((x + dx) / self._step), round((y + dy) / self._step), cell)
            for name, x, y in self._references["LAYOUT"]
            for cell, dx, dy in self._references[name]
        ]

    def __getitem__(self, rows: slice) -> np.ndarray:
        top, bottom, _ = rows.indices(self.shape[0])
        low, high = self.shape[0] - bottom, self.shape[0] - top
        # Each corner of a rectangle adds to everything above and to the right of it.
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
        """Where the shapes of every cell lie in the file, and to which cells it refers."""
        at, cell, name = 0, "", ""
        while True:
            # No record but those of shapes is longer.
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
        """How many rectangles follow in the file."""
        count = 0
        while True:
            start = at + count * _RECTANGLE.itemsize
            part = np.fromfile(self._path, _RECTANGLE, _CHUNK, offset=start)
            other = np.flatnonzero(part["start"] != _START)
            if other.size or len(part) < _CHUNK:
                return count + (int(other[0]) if other.size else len(part))
            count += len(part)
