"""Layouts as GDSII, one layer per level (extra ``gds``), and back."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from litho_data.foundation.errors import InputError

_UNIT_M = 1e-6
_PRECISION_M = 1e-9

GdsLayers = Literal["cumulative", "exclusive"]


def write_gds(path: Path, levels: np.ndarray, pitch_um: float, layers: GdsLayers) -> int:
    """Write rectangles, unit 1 µm, grid 1 nm, y up; returns their number.

    Layer k holds {level >= k} (``cumulative``, k from 1) or {level == k} (``exclusive``, k from 0).
    Runs along rows are merged over equal rows below them, so every shape is a rectangle.

    Raises:
        InputError: gdstk is not installed.
    """
    gdstk = _gdstk()
    library = gdstk.Library(unit=_UNIT_M, precision=_PRECISION_M)
    cell = library.new_cell("LAYOUT")
    highest = int(levels.max())
    masks = (
        [(k, levels >= k) for k in range(1, highest + 1)]
        if layers == "cumulative"
        else [(k, levels == k) for k in range(highest + 1)]
    )
    total = 0
    for layer, mask in masks:
        for top, bottom, left, right in rectangles(mask):
            y_low, y_high = (levels.shape[0] - bottom) * pitch_um, (levels.shape[0] - top) * pitch_um
            cell.add(gdstk.rectangle((left * pitch_um, y_low), (right * pitch_um, y_high), layer=layer))
            total += 1
    library.write_gds(path)
    return total


def read_gds_levels(path: Path, shape: tuple[int, int], pitch_um: float, layers: GdsLayers) -> np.ndarray:
    """Levels uint8 (ny, nx), row 0 on top, of a file written by ``write_gds``."""
    cell = _gdstk().read_gds(path).cells[0]
    levels = np.zeros(shape, np.uint8)
    for polygon in cell.polygons:
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
