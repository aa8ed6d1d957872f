"""The geometry and levels of layouts."""

from __future__ import annotations

from typing import Literal

from litho_data.commands.settings import setting
from litho_data.foundation.errors import InputError
from litho_data.foundation.quantities import LEVEL_HEIGHT_UM, PITCH_UM
from litho_data.foundation.results import Record


class LayoutSettings(Record):
    """Geometry of a layout: its pixels, its free cells and its levels. A free cell is an area of one level,
    which the design chooses.

    ``cell_um`` is the side of a free cell or, if ``symmetry`` is "radial", the width of a ring.
    """

    size_px: int = setting(1024, "Side of the element", unit="px", option="--size-px", ge=4)
    pitch_um: float = setting(
        0.1,
        "Side of a pixel, which must equal that of the model",
        unit="µm",
        option="--pitch-um",
        ge=PITCH_UM.low,
        le=PITCH_UM.high,
    )
    cell_um: float = setting(
        0.4, "Side of a free cell, or width of a ring", unit="µm", option="--cell-um", gt=0
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
        """Return the side of the element, µm."""
        return self.size_px * self.pitch_um

    @property
    def ring_px(self) -> float:
        """Return the width of a ring in pixels; it need not be a whole number.

        Raises:
            InputError: the rings are narrower than a pixel.
        """
        # The width is rounded because 0.7 / 0.1 is a little less than 7, which would move pixels on an edge
        # to another ring.
        width_px = round(self.cell_um / self.pitch_um, 9)
        if width_px < 1:
            wanted = f"rings at least one pixel ({self.pitch_um} µm) wide"
            raise InputError("cell_um", got=f"{self.cell_um} µm", wanted=wanted)
        return width_px

    @property
    def cell_px(self) -> int:
        """Return the number of pixels along the side of a cell.

        Raises:
            InputError: the cells are not a whole number of pixels wide, or do not fill the element.
        """
        cell_px = round(self.cell_um / self.pitch_um)
        if cell_px < 1 or abs(cell_px * self.pitch_um - self.cell_um) > 1e-9 or self.size_px % cell_px:
            raise InputError(
                "cell_um",
                got=f"{self.cell_um} µm",
                wanted=f"a whole number of pixels of {self.pitch_um} µm that divides {self.size_px} px",
            )
        return cell_px
