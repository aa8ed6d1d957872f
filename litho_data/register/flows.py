"""Define the generators of the warps on every rung of the ladder, and the quadratic flows."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from litho_data.foundation import Array, Shape

Model = Literal["translation", "euclidean", "similarity", "affine", "homography"]
# The number of generators that each rung of the ladder uses. Each rung starts from the first generator, so it
# contains all lower rungs.
LADDER: dict[Model, int] = {"translation": 2, "euclidean": 3, "similarity": 4, "affine": 6, "homography": 8}
GENERATORS = np.zeros((8, 3, 3))
GENERATORS[0, 0, 2] = GENERATORS[1, 1, 2] = 1.0
GENERATORS[2, 0, 1], GENERATORS[2, 1, 0] = -1.0, 1.0
GENERATORS[3, 0, 0] = GENERATORS[3, 1, 1] = 1.0
GENERATORS[4, 0, 0], GENERATORS[4, 1, 1] = 1.0, -1.0
GENERATORS[5, 0, 1] = GENERATORS[5, 1, 0] = 1.0
GENERATORS[6, 2, 0] = GENERATORS[7, 2, 1] = 1.0
# Number of flows of an affine map and a bend together. Two combinations of the six quadratic flows are the
# generators of perspective.
BENT_COUNT = 12


def normalisation(shape: Shape) -> Array:
    """Return the matrix from indices to centred coordinates of order one, with equal scales on both axes."""
    scale = 2.0 / (max(shape) - 1)
    ny, nx = shape
    return np.array([[scale, 0, -scale * (nx - 1) / 2], [0, scale, -scale * (ny - 1) / 2], [0, 0, 1]])


def _flow(generator: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Return the velocity (along x, along y) of normalised points under a generator, broadcasting x and y."""
    coordinates = (x, y, np.ones(1, dtype=x.dtype))
    zero = np.zeros(1, dtype=x.dtype)
    moved_x, moved_y, weight = (
        sum((float(row[k]) * coordinates[k] for k in np.flatnonzero(row)), start=zero) for row in generator
    )
    return moved_x - weight * x, moved_y - weight * y


def flows(count: int, x: Array, y: Array) -> Iterator[tuple[Array, Array]]:
    """Yield the velocities of the first ``count`` generators.

    If ``count`` is ``BENT_COUNT``, yield those of all affine and quadratic flows.
    """
    for generator in GENERATORS[:count]:
        yield _flow(generator, x, y)
    if count == BENT_COUNT:
        zero = np.zeros(1, dtype=x.dtype)
        yield from ((x * x, zero), (y * y, zero), (zero, x * x), (zero, y * y))
