"""The pixel grid of an array, given by its shape, pitch and origin. All three packages of the project use
it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import YX, Array
from litho_data.foundation.quantities import PITCH_UM


@dataclass(frozen=True)
class PixelGrid:
    """A rectangular grid of square or rectangular pixels, with row 0 at the top.

    Args:
        shape: number of rows and number of columns, (ny, nx).
        pitch_um: distances between pixel centres along y and along x, µm.
        origin_um: position (y, x) of the top-left *corner* of pixel (0, 0), µm; the centre of row or column i
            therefore lies at ``origin + (i + 0.5) * pitch``.

    Raises:
        InputError: the grid is smaller than one pixel, or the pitch is out of range.
    """

    shape: tuple[int, int]
    pitch_um: YX
    origin_um: YX = (0.0, 0.0)

    def __post_init__(self) -> None:
        if min(self.shape) < 1:
            raise InputError("grid shape", got=self.shape, wanted="at least 1 x 1 pixels")
        PITCH_UM.require("grid pitch_um", self.pitch_um)

    @classmethod
    def square(cls, shape: tuple[int, int], pitch_um: float) -> PixelGrid:
        """Make a grid of square pixels whose top-left corner lies at (0, 0)."""
        return cls((int(shape[0]), int(shape[1])), (float(pitch_um), float(pitch_um)))

    @property
    def size_um(self) -> YX:
        """Return the extent of the grid along y and along x, from edge to edge, in µm."""
        return self.shape[0] * self.pitch_um[0], self.shape[1] * self.pitch_um[1]

    @property
    def y_um(self) -> Array:
        """Return the y coordinates of the row centres in µm, shape (ny,)."""
        return self.origin_um[0] + (np.arange(self.shape[0]) + 0.5) * self.pitch_um[0]

    @property
    def x_um(self) -> Array:
        """Return the x coordinates of the column centres in µm, shape (nx,)."""
        return self.origin_um[1] + (np.arange(self.shape[1]) + 0.5) * self.pitch_um[1]
