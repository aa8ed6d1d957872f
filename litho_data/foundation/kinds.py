"""Types that many signatures use: maps, their shapes, pairs of lengths along y and x, plain data."""

from collections.abc import Mapping
from typing import Any

import numpy as np

Array = np.ndarray
Shape = tuple[int, ...]
"""(ny, nx), pixels."""
YX = tuple[float, float]
"""(along y, along x): a pitch, a size or a position."""
Facts = Mapping[str, Any]
"""Plain data by name, such as parameters, attributes or a record."""
