"""Layouts: their geometry and levels, and what a printer must resolve to print them."""

from __future__ import annotations

from typing import Literal

import numpy as np

from litho_data.commands.settings import setting
from litho_data.foundation.errors import InputError
from litho_data.foundation.quantities import LEVEL_HEIGHT_UM, PITCH_UM
from litho_data.foundation.results import Record

_LARGE_JUMP_LEVELS = 8


class LayoutSettings(Record):
    """Geometry of a layout: pixels, free cells and levels.

    ``cell_um`` is the side of one free cell, or the width of one ring with ``symmetry="radial"``.
    """

    size_px: int = setting(1024, "Side of the element", unit="px", option="--size-px", ge=4)
    pitch_um: float = setting(
        0.1,
        "Side of a pixel, which must be that of the model",
        unit="µm",
        option="--pitch-um",
        ge=PITCH_UM.low,
        le=PITCH_UM.high,
    )
    cell_um: float = setting(
        0.4, "Side of a free cell (hologram) or width of a ring (lens)", unit="µm", option="--cell-um", gt=0
    )
    cell_filter_um: float = setting(
        0.0,
        "Standard deviation of a Gaussian filter over the free cells, so that neighbours change together; "
        "0 for none",
        unit="µm",
        option="--cell-filter-um",
        ge=0,
    )
    levels: int = setting(13, "Number of printable levels", option="--levels", ge=2, le=256)
    level_height_um: float = setting(
        0.1,
        "Height of one level",
        unit="µm",
        option="--level-height-um",
        ge=LEVEL_HEIGHT_UM.low,
        le=LEVEL_HEIGHT_UM.high,
    )
    symmetry: Literal["none", "radial"] = setting("none", "Whether the free cells are rings around the axis")

    @property
    def size_um(self) -> float:
        """Side of the element, µm."""
        return self.size_px * self.pitch_um

    @property
    def ring_px(self) -> float:
        """Width of a ring in pixels; it need not be a whole number.

        Raises:
            InputError: rings narrower than a pixel.
        """
        # 0.7 / 0.1 is a little less than 7, and a pixel on the edge would change its ring.
        width_px = round(self.cell_um / self.pitch_um, 9)
        if width_px < 1:
            wanted = f"rings of a pixel, {self.pitch_um} µm, or wider"
            raise InputError("cell_um", got=f"{self.cell_um} µm", wanted=wanted)
        return width_px

    @property
    def cell_px(self) -> int:
        """Pixels per cell side.

        Raises:
            InputError: cells that are not a whole number of pixels, or that do not fill the element.
        """
        cell_px = round(self.cell_um / self.pitch_um)
        if cell_px < 1 or abs(cell_px * self.pitch_um - self.cell_um) > 1e-9 or self.size_px % cell_px:
            raise InputError(
                "cell_um",
                got=f"{self.cell_um} µm",
                wanted=f"whole pixels of {self.pitch_um} µm that divide {self.size_px} px",
            )
        return cell_px


class Printability(Record):
    """Fabrication figures of a layout: lengths in µm, and shares of the pairs of neighbouring pixels."""

    pitch_um: float
    free_cell_um: float
    highest_um: float
    smallest_feature_um: float
    single_pixel_feature_share: float
    steepest_step_um: float
    steepest_slope: float
    large_jump_share: float
    used_levels: int
    smallest_ring_um: float | None = None


def printability(levels: np.ndarray, layout: LayoutSettings) -> Printability:
    """What a printer must resolve to print a layout.

    A feature is a run of pixels of one level along a row or a column that ends at other levels on both sides.
    Runs that touch the border are not counted, because they may continue in a neighbour. In a ring layout,
    rows cut rings at every angle, so the narrowest ring along a radius is also given.

    Args:
        levels: integer levels (ny, nx).
    """
    runs = np.concatenate([_inner_runs(levels), _inner_runs(levels.T)])
    steps = np.concatenate([np.abs(np.diff(levels.astype(np.int16), axis=axis)).ravel() for axis in (0, 1)])
    steepest = float(steps.max(initial=0)) * layout.level_height_um
    return Printability(
        pitch_um=layout.pitch_um,
        free_cell_um=layout.cell_um,
        highest_um=float(levels.max()) * layout.level_height_um,
        smallest_feature_um=float(runs.min(initial=max(levels.shape))) * layout.pitch_um,
        single_pixel_feature_share=float((runs == 1).mean()) if runs.size else 0.0,
        steepest_step_um=steepest,
        steepest_slope=steepest / layout.pitch_um,
        large_jump_share=float((steps >= _LARGE_JUMP_LEVELS).mean()) if steps.size else 0.0,
        used_levels=len(np.unique(levels)),
        smallest_ring_um=_smallest_ring_um(levels, layout),
    )


def _smallest_ring_um(levels: np.ndarray, layout: LayoutSettings) -> float | None:
    """Narrowest run of one level along the radius; None without rings, or with only one level."""
    if layout.symmetry != "radial":
        return None
    middle_y, middle_x = (side // 2 for side in levels.shape)
    edges = np.flatnonzero(np.diff(levels[middle_y, middle_x:].astype(int))) + 1
    if edges.size == 0:
        return None
    # The central disc is twice as wide as its run, and the outermost ring may be cut.
    widths = [2 * int(edges[0]), *np.diff(edges).tolist()]
    return min(widths) * layout.pitch_um


def _inner_runs(levels: np.ndarray) -> np.ndarray:
    """Lengths, pixels, of the runs of equal level along the rows that touch no border."""
    lengths = []
    for row in levels:
        edges = np.flatnonzero(np.diff(row)) + 1
        lengths.append(np.diff(edges))
    return np.concatenate(lengths) if lengths else np.empty(0, int)
