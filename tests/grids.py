"""Grids for tests of all packages. On these grids, confusing the axes always changes the result.

Some fields are taller than wide, others wider than tall. Their numbers of pixels are even or odd, their
pixels are longer along one axis than along the other, and their corners do not lie at the origin. Therefore,
tests notice a transposed pair, the size of the wrong axis, and a shift by half a pixel.
"""

from __future__ import annotations

from litho_data.foundation.grid import PixelGrid

UNEQUAL = {
    "high, even and odd": PixelGrid((46, 33), (0.13, 0.08), (0.7, -1.1)),
    "wide, odd and even": PixelGrid((37, 58), (0.07, 0.11), (-2.3, 0.4)),
    "even": PixelGrid((40, 64), (0.1, 0.16), (0.05, 3.2)),
    "odd": PixelGrid((51, 35), (0.12, 0.09), (-0.3, -0.9)),
}
SHAPES = [grid.shape for grid in UNEQUAL.values()]
