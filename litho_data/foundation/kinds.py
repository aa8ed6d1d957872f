"""Types that many signatures use: maps, their shapes, pairs of lengths along y and x, plain data."""

from collections.abc import Mapping
from typing import Any

import numpy as np

Array = np.ndarray
Shape = tuple[int, ...]
"""(ny, nx), pixels."""
YX = tuple[float, float]
"""A pitch, a size or a position: the values along y and along x."""
Facts = Mapping[str, Any]
"""Plain data, keyed by name, such as parameters, attributes or a record."""
