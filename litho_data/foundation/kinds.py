"""Type aliases that many signatures use: arrays, their shapes, pairs of lengths along y and x, plain data."""

from collections.abc import Mapping
from typing import Any

import numpy as np

Array = np.ndarray
Shape = tuple[int, ...]
"""Shape of a map in pixels: the number of rows and of columns, (ny, nx)."""
YX = tuple[float, float]
"""A pitch, a size or a position: the values along y and along x."""
Facts = Mapping[str, Any]
"""Plain data, keyed by name, such as parameters, attributes or a record."""
