"""Define the kinds of warp by their generators. A generator is a 3×3 matrix that describes one way in which a
warp can change, such as a shift, a rotation or a change of scale. If the warp changes in this way, every
point moves. The module computes the velocities (flows) of the points.

The kinds of warp form a ladder, in which each kind contains all simpler kinds.
"""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from litho_data.foundation import Array, Shape

Model = Literal["translation", "euclidean", "similarity", "affine", "homography"]
# The number of generators of each kind of warp. A kind with n generators uses the first n of ``GENERATORS``,
# so it contains all kinds before it.
LADDER: dict[Model, int] = {"translation": 2, "euclidean": 3, "similarity": 4, "affine": 6, "homography": 8}
GENERATORS = np.zeros((8, 3, 3))
GENERATORS[0, 0, 2] = GENERATORS[1, 1, 2] = 1.0
GENERATORS[2, 0, 1], GENERATORS[2, 1, 0] = -1.0, 1.0
GENERATORS[3, 0, 0] = GENERATORS[3, 1, 1] = 1.0
GENERATORS[4, 0, 0], GENERATORS[4, 1, 1] = 1.0, -1.0
GENERATORS[5, 0, 1] = GENERATORS[5, 1, 0] = 1.0
GENERATORS[6, 2, 0] = GENERATORS[7, 2, 1] = 1.0
# Number of flows of an affine map together with a bend: six affine and six quadratic flows. The two
# generators of perspective are combinations of the quadratic flows, so only four flows are added to the eight
# generators.
BENT_COUNT = 12


def normalisation(shape: Shape) -> Array:
    """Return the 3×3 matrix from pixel indices to normalised coordinates. Normalised coordinates are zero at
    the centre, have the same scale on both axes, and run from -1 to 1 along the longer side.
    """
    scale = 2.0 / (max(shape) - 1)
    ny, nx = shape
    return np.array([[scale, 0, -scale * (nx - 1) / 2], [0, scale, -scale * (ny - 1) / 2], [0, 0, 1]])


def _flow(generator: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Return the velocities, along x and along y, that a generator gives to the points (x, y). The points are
    in normalised coordinates, and the arrays x and y are broadcast against each other.
    """
    coordinates = (x, y, np.ones(1, dtype=x.dtype))
    zero = np.zeros(1, dtype=x.dtype)
    moved_x, moved_y, weight = (
        sum((float(row[k]) * coordinates[k] for k in np.flatnonzero(row)), start=zero) for row in generator
    )
    return moved_x - weight * x, moved_y - weight * y


def flows(count: int, x: Array, y: Array) -> Iterator[tuple[Array, Array]]:
    """For each of the first ``count`` generators, yield the velocities of the points (x, y) along x and along
    y.

    If ``count`` is ``BENT_COUNT``, yield the velocities of all eight generators and of four quadratic flows.
    Every affine or quadratic flow is a combination of these twelve.
    """
    for generator in GENERATORS[:count]:
        yield _flow(generator, x, y)
    if count == BENT_COUNT:
        zero = np.zeros(1, dtype=x.dtype)
        yield from ((x * x, zero), (y * y, zero), (zero, x * x), (zero, y * y))


def changes(field: Array, count: int) -> Array:
    """Return how a map changes if its points move by each flow, in pixels: the flow times the gradient of the
    map. ``field`` has shape (ny, nx), and the result has shape (flows, ny, nx).
    """
    scale = normalisation(field.shape)
    x, y = (
        (scale[axis, axis] * np.arange(field.shape[1 - axis]) + scale[axis, 2]).astype(field.dtype)
        for axis in (0, 1)
    )
    gradient_y, gradient_x = np.gradient(field)
    return np.stack(
        [
            along_x * gradient_x + along_y * gradient_y
            for along_x, along_y in flows(count, x[None, :], y[:, None])
        ]
    )
