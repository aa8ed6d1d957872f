"""Layouts as GDSII, one layer per level in cells that repeat (extra ``gds``), and back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from litho_data.foundation.errors import InputError

_UNIT_M = 1e-6
_PRECISION_M = 1e-9

# Side of the blocks that a part is cut into.
_BLOCK_PX = 128

GdsLayers = Literal["cumulative", "exclusive"]


def write_gds(
    path: Path,
    levels: np.ndarray,
    pitch_um: float,
    layers: GdsLayers,
    parts: Mapping[str, tuple[int, int, int, int]] | None = None,
) -> int:
    """Write rectangles, unit 1 µm, grid 1 nm, y up; returns how many the file holds.

    Layer k holds {level >= k} (``cumulative``, k from 1) or {level == k} (``exclusive``, k from 0).
    Runs along rows are merged over equal rows below them, so every shape is a rectangle. The cell LAYOUT
    refers to one cell for every part, and that to blocks of 128 pixels: equal blocks are one cell.

    Args:
        parts: rows from, to, columns from, to, of each part by name; the whole map is ELEMENT by default.

    Raises:
        InputError: gdstk is not installed.
    """
    gdstk = _gdstk()
    library = gdstk.Library(unit=_UNIT_M, precision=_PRECISION_M)
    layout = library.new_cell("LAYOUT")
    blocks: dict[tuple[tuple[int, ...], bytes], Any] = {}
    height = len(levels)
    for name, (top, bottom, left, right) in (parts or {"ELEMENT": (0, height, 0, levels.shape[1])}).items():
        part = library.new_cell(name)
        for row in range(top, bottom, _BLOCK_PX):
            for column in range(left, right, _BLOCK_PX):
                block = levels[row : min(row + _BLOCK_PX, bottom), column : min(column + _BLOCK_PX, right)]
                known = (block.shape, block.tobytes())
                if known not in blocks:
                    blocks[known] = library.new_cell(f"BLOCK_{len(blocks)}")
                    blocks[known].add(*_shapes(gdstk, block, pitch_um, layers))
                place = ((column - left) * pitch_um, (bottom - row - len(block)) * pitch_um)
                part.add(gdstk.Reference(blocks[known], place))
        layout.add(gdstk.Reference(part, (left * pitch_um, (height - bottom) * pitch_um)))
    library.write_gds(path)
    return sum(len(block.polygons) for block in blocks.values())


def _shapes(gdstk: Any, levels: np.ndarray, pitch_um: float, layers: GdsLayers) -> list[Any]:
    """The rectangles of one block, its lower left corner at 0."""
    highest = int(levels.max())
    masks = (
        [(k, levels >= k) for k in range(1, highest + 1)]
        if layers == "cumulative"
        else [(k, levels == k) for k in range(highest + 1)]
    )
    return [
        gdstk.rectangle(
            (left * pitch_um, (len(levels) - bottom) * pitch_um),
            (right * pitch_um, (len(levels) - top) * pitch_um),
            layer=layer,
        )
        for layer, mask in masks
        for top, bottom, left, right in rectangles(mask)
    ]


def read_gds_levels(path: Path, shape: tuple[int, int], pitch_um: float, layers: GdsLayers) -> np.ndarray:
    """Levels uint8 (ny, nx), row 0 on top, of a file written by ``write_gds``."""
    (layout,) = _gdstk().read_gds(path).top_level()
    levels = np.zeros(shape, np.uint8)
    for polygon in layout.get_polygons():
        (left, low), (right, high) = (
            np.rint(np.asarray(corner) / pitch_um).astype(int) for corner in polygon.bounding_box()
        )
        block = levels[shape[0] - high : shape[0] - low, left:right]
        block[...] = np.maximum(block, polygon.layer)
    return levels


def rectangles(mask: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Disjoint rectangles (top, bottom, left, right), ends excluded, that cover a boolean mask."""
    open_runs: dict[tuple[int, int], int] = {}
    done = []
    for row in range(len(mask) + 1):
        runs = set()
        if row < len(mask):
            edges = np.flatnonzero(np.diff(np.pad(mask[row].astype(np.int8), 1)))
            runs = {(int(a), int(b)) for a, b in edges.reshape(-1, 2)}
        for run in [run for run in open_runs if run not in runs]:
            done.append((open_runs.pop(run), row, *run))
        for run in runs:
            open_runs.setdefault(run, row)
    return done


def _gdstk() -> Any:
    try:
        import gdstk
    except ImportError:
        raise InputError("GDS export", got="no gdstk", hint="install litholoop[gds]") from None
    return gdstk
