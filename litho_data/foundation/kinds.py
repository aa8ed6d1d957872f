"""Types that nearly every signature uses: maps, their shapes, and pairs of lengths along y and x."""

import numpy as np

Array = np.ndarray
Shape = tuple[int, ...]
"""(ny, nx), pixels."""
YX = tuple[float, float]
"""Along y and along x: a pitch, a size, a place."""
