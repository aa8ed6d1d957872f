"""Write layouts as GDSII, one band of rows at a time. The file has one layer per level. Blocks of pixels with
the same content share one GDS cell.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from litho_design.exports.job import GdsLayers
from litho_design.exports.rows import LevelRows

_UNIT_M = 1e-6
_PRECISION_M = 1e-9

# Side of the square blocks into which a part of the map is divided.
_BLOCK_PX = 128
Box = tuple[int, int, int, int]


def write_gds(
    path: Path,
    levels: LevelRows,
    pitch_um: float,
    layers: GdsLayers,
    parts: Mapping[str, Box] | None = None,
) -> int:
    """Write a layout as rectangles. Coordinates are in µm on a grid of 1 nm, and y points upwards. Return the
    number of rectangles in the file.

    Layer k contains the pixels with level >= k (``cumulative``; k starts at 1) or the pixels with level == k
    (``exclusive``; k starts at 0). A run of such pixels along a row is merged with equal runs in the rows
    below, so every shape is a rectangle. The GDS cell LAYOUT references one GDS cell for each part. The GDS
    cell of a part references one GDS cell for each band of 128 rows. The GDS cell of a band references the
    GDS cells of its blocks, which are 128 pixels wide. Equal blocks share a GDS cell. Only the shapes of one
    block are in memory at a time.

    Args:
        parts: mapping from the name of each part to its box (first row, end row, first column, end column),
            where the ends are exclusive. By default, the whole map is one part, named ELEMENT.
    """
    import gdstk

    known: dict[bytes, gdstk.Cell] = {}
    height, width = levels.shape
    drawn, layout = 0, gdstk.Cell("LAYOUT")
    # The time stamp is fixed, so that equal layouts give equal files.
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
                    # Later references to this GDS cell need only its name, so its shapes need not stay in
                    # memory.
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
    """Return the rectangles of one block. The origin is the lower left corner of the block."""
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
    """Cover the True pixels of n boolean masks, shape (n, ny, nx), with disjoint rectangles.

    The result has shape (m, 5). Its columns are the number of the mask, the rows ``top`` and ``bottom``, and
    the columns ``left`` and ``right`` of a rectangle. The row ``bottom`` and the column ``right`` lie just
    outside the rectangle.
    """
    edges = np.diff(np.pad(masks.astype(np.int8), ((0, 0), (0, 0), (1, 1))), axis=2)
    mask, row, left = np.nonzero(edges > 0)
    right = np.nonzero(edges < 0)[2]
    # Runs of one mask that begin and end in the same columns are sorted from top to bottom. A rectangle ends
    # where the next row has no such run.
    order = np.lexsort([row, right, left, mask])
    mask, row, left, right = (one[order] for one in (mask, row, left, right))
    new = np.ones(len(row) + 1, bool)
    new[1:-1] = (np.diff(row) != 1) | np.any(np.diff([mask, left, right]), axis=0)
    first, last = np.flatnonzero(new[:-1]), np.flatnonzero(new[1:])
    return np.stack([mask[first], row[first], row[last] + 1, left[first], right[first]], axis=1)
