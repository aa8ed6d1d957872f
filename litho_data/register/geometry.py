"""Convert positions between pixel indices, micrometres, and rotated or mirrored images.

Points are rows ``(x, y)`` of an array. Matrices are 3×3 and act on ``(x, y, 1)``. In the *index* frame of an
image, pixel centres lie at 0, 1, 2, … In the image's micrometre frame, pixel centres lie at ``(i + 0.5) *
pitch_um``.
"""

import numpy as np

from litho_data.foundation import YX, Array, Shape
from litho_data.register.bend import Bend
from litho_data.scan import Axis

# Each name has three flags, one for each of three operations: to transpose the scan, to reverse the order of
# its rows, and to reverse the order of its columns. The operations are applied in this order, and give the
# scan the orientation of the layout.
ORIENTATIONS: dict[str, tuple[bool, bool, bool]] = {
    "identity": (False, False, False),
    "rotate-90": (True, True, False),
    "rotate-180": (False, True, True),
    "rotate-270": (True, False, True),
    "flip-x": (False, False, True),
    "flip-y": (False, True, False),
    "transpose": (True, False, False),
    "anti-transpose": (True, True, True),
}


def index_to_um(pitch_um: YX) -> Array:
    """Return the matrix that maps pixel indices (x, y) to µm. The pitch is given as (y, x)."""
    pitch_y, pitch_x = pitch_um
    return np.array([[pitch_x, 0.0, pitch_x / 2], [0.0, pitch_y, pitch_y / 2], [0.0, 0.0, 1.0]])


def orient(image: Array, orientation: str) -> Array:
    """Return a view of the image, rotated or mirrored by one of the eight operations in ``ORIENTATIONS``."""
    transpose, flip_y, flip_x = ORIENTATIONS[orientation]
    turned = image.T if transpose else image
    turned = turned[::-1] if flip_y else turned
    return turned[:, ::-1] if flip_x else turned


def orientation_matrix(orientation: str, shape: Shape) -> Array:
    """Return the matrix that maps pixel indices of an image to pixel indices of ``orient(image,
    orientation)``.

    ``shape`` is the shape (ny, nx) of the image.
    """
    transpose, flip_y, flip_x = ORIENTATIONS[orientation]
    ny, nx = shape[::-1] if transpose else shape
    matrix = np.eye(3)
    if transpose:
        matrix = matrix[[1, 0, 2]]
    if flip_y:
        matrix = np.array([[1.0, 0, 0], [0, -1, ny - 1], [0, 0, 1]]) @ matrix
    if flip_x:
        matrix = np.array([[-1.0, 0, nx - 1], [0, 1, 0], [0, 0, 1]]) @ matrix
    return matrix


def slow_axis(orientation: str, fast_axis: Axis | None) -> int:
    """Return the slow axis (0 = x, 1 = y) of an oriented scan, which is the axis across its scan lines.

    ``fast_axis`` is the direction of the lines in the scan as it was read. None counts as x.
    """
    transposed = ORIENTATIONS[orientation][0]
    return int((fast_axis == "y") == transposed)


def nearest_orientation(linear: Array) -> str:
    """Return the name of the orientation whose matrix is closest, in the Frobenius norm, to the given 2×2
    matrix. The given matrix is first scaled to a determinant of ±1.
    """
    unit = linear / np.sqrt(abs(np.linalg.det(linear)))

    def distance(name: str) -> float:
        return float(np.linalg.norm(unit - orientation_matrix(name, (1, 1))[:2, :2]))

    return min(ORIENTATIONS, key=distance)


def apply_transform(matrix: Array, points: Array) -> Array:
    """Map points (x, y) by a 3×3 matrix. The points and the result have shape (n, 2)."""
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    return homogeneous[:, :2] / homogeneous[:, 2:]


def warped_grid(matrix: Array, shape: Shape, bend: Bend | None = None) -> tuple[Array, Array]:
    """Map the pixels of an image of the given shape by a 3×3 matrix, and return their positions in a target
    image.

    The matrix acts on pixel indices. The result is a pair of arrays: the rows and the columns of the
    positions. ``bend`` is the bend of the target image. If it is given, the matrix gives true positions, and
    the function returns the nominal positions, at which the points appear in the bent image.
    """
    y = np.arange(shape[0], dtype=float)[:, None]
    x = np.arange(shape[1], dtype=float)[None, :]
    mapped_x, mapped_y, weight = (row[0] * x + row[1] * y + row[2] for row in matrix)
    if bend is None:
        return mapped_y / weight, mapped_x / weight
    return bend.undo(mapped_x / weight, mapped_y / weight)[::-1]


def overlap_of(
    layout_to_scan: Array, layout_shape: Shape, measured: Array, bend: Bend | None = None
) -> Array:
    """Return a bool mask of shape ``layout_shape`` that is true at layout pixels whose centres fall on
    measured pixels of the scan.
    """
    rows, columns = warped_grid(layout_to_scan, layout_shape, bend)
    ny, nx = measured.shape
    inside = (rows >= 0) & (rows <= ny - 1) & (columns >= 0) & (columns <= nx - 1)
    return inside if measured.all() else inside & nearest(measured, rows, columns)


def nearest(image: Array, rows: Array, columns: Array) -> Array:
    """Return the values of an image at the pixels nearest to the given positions."""
    clipped = (np.clip(np.rint(k), 0, n - 1) for k, n in zip((rows, columns), image.shape, strict=True))
    return image[tuple(k.astype(int) for k in clipped)]


def lattice(y: Array, x: Array) -> Array:
    """Return the points of the grid with the given y and x coordinates, row by row. The result has shape (n,
    2) with columns x and y.
    """
    return np.stack([one.ravel() for one in np.meshgrid(x, y)], axis=1)


def linear_part(matrix: Array, point: Array) -> Array:
    """Return the 2×2 Jacobian of a 3×3 map at a point (x, y). It describes the local scale, rotation and
    shear.
    """
    mapped = apply_transform(matrix, point[None])[0]
    weight = matrix[2, :2] @ point + matrix[2, 2]
    return (matrix[:2, :2] - np.outer(mapped, matrix[2, :2])) / weight


def corners(shape: Shape) -> Array:
    """Return the index coordinates (x, y) of the four corner pixels, shape (4, 2)."""
    ny, nx = shape
    return np.array([[0.0, 0], [nx - 1, 0], [0, ny - 1], [nx - 1, ny - 1]])


def centre(shape: Shape) -> Array:
    """Return the index coordinates (x, y) of the centre of an image, shape (2,)."""
    return np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
