"""Refine a registration to sub-pixel accuracy, by maximising the correlation of the scan with the predicted
topography.

The correlation is maximised by Gauss-Newton steps in the inverse compositional form. A warp, a gain and a
quadratic background are fitted at the same time. Sources: G. D. Evangelidis, E. Z. Psarakis, IEEE TPAMI 30
(2008), doi:10.1109/TPAMI.2008.113; S. Baker, I. Matthews, IJCV 56 (2004),
doi:10.1023/B:VISI.0000011205.11775.fd.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from litho_data.foundation import Array, Shape
from litho_data.register.bend import Bend
from litho_data.register.flows import BENT_COUNT, GENERATORS, LADDER, Model, changes, flows, normalisation
from litho_data.register.geometry import apply_transform, corners, warped_grid
from litho_data.register.topography import fill_gaps, quadratic_basis

NUISANCES = 7  # coefficients before those of the warp: the gain of the topography and six quadratic terms
_BACKGROUND_AND_SCAN = [1, 2, 3, 4, 5, 6, -1]
CELL_PX = 32
# Pixels closer than this to the layout's border are not used, because their blurred heights depend on the
# unknown surroundings of the print, such as bare ground or another print beside it.
BORDER_PX = 8
TOLERANCE_PX = 1e-3


@dataclass(frozen=True)
class Refinement:
    """A refined warp, with the sums from which its uncertainty is computed.

    ``layout_to_scan`` is the 3×3 matrix from pixel indices of the layout to pixel indices of the scan. For a
    scan with a ``bend``, the pixel indices of the scan are those of the straightened scan. ``warped`` is the
    scan on the layout's pixels, with its gaps filled. It is a float32 array of shape (ny, nx).

    The field is divided into cells with sides of about ``CELL_PX`` pixels. For every cell, ``gram`` contains
    the matrix of inner products of the regressors with each other and with the scan. Its shape is (cells_y,
    cells_x, k, k). The regressors are those of the gain, of the background and of the warp, in this order.
    The scan comes last. These sums suffice to fit the warp again to any part of the field.
    """

    model: Model
    layout_to_scan: Array
    warped: Array
    gram: Array
    converged: bool
    bend: Bend | None = None

    def blocks(self) -> Array:
        """Return the inner products in ``gram``, summed over blocks of cells by ``in_blocks``."""
        return in_blocks(self.gram)

    @property
    def background(self) -> Array:
        """Return the six coefficients of the quadratic surface that was fitted together with the warp."""
        return solve_gram(self.gram.sum(axis=(0, 1)))[1:NUISANCES]

    @property
    def correlation(self) -> float:
        """Return the correlation of scan and topography after the quadratic background has been removed from
        both (their partial correlation). It is 0 if the fitted gain is not positive.
        """
        total = self.gram.sum(axis=(0, 1))
        background = total[np.ix_(_BACKGROUND_AND_SCAN, _BACKGROUND_AND_SCAN)]
        coefficients = solve_gram(total)
        energy = float(residual_energy(background, solve_gram(background)))
        if energy <= 0 or coefficients[0] <= 0:
            return 0.0
        return max(0.0, 1 - float(residual_energy(total, coefficients)) / energy) ** 0.5


def refine(
    scan: Array,
    topography: Array,
    start: Array,
    model: Model,
    *,
    bend: Bend | None = None,
    max_iterations: int = 30,
    tolerance_px: float = TOLERANCE_PX,
) -> Refinement:
    """Find the warp of the kind ``model`` that maximises the correlation of scan and topography.

    Args:
        scan: smoothed heights, shape (ny, nx), NaN where not measured.
        topography: topography predicted from the layout, shape (ny, nx).
        start: the warp at which the search starts, a 3×3 matrix from pixel indices of the layout to pixel
            indices of the scan. It must be of the kind ``model``. Its position error may be as large as the
            width of the printed structures.
        model: the kind of warp.
        bend: bend of the scan. If a bend is given, ``start`` must be an affine map, and warp and bend are
            evaluated but not refined.
        max_iterations: largest number of Gauss-Newton steps. With 0, ``start`` is evaluated but not refined.
        tolerance_px: the search ends when a step moves every corner of the layout by less than this many
            pixels.
    """
    from scipy.linalg import expm
    from scipy.ndimage import map_coordinates, spline_filter

    shape = topography.shape
    normalise = normalisation(shape)
    denormalise = np.linalg.inv(normalise)
    regressors = _regressors(topography, LADDER[model] if bend is None else BENT_COUNT)
    interior = interior_of(shape)
    measured = np.isfinite(scan)
    complete = bool(measured.all())
    spline = spline_filter(fill_gaps(scan), 3, output=np.float32, mode="mirror")
    matrix, converged, step_px = np.array(start, dtype=float), False, np.inf
    for iteration in range(max_iterations + 1):
        rows, columns = warped_grid(matrix, shape, bend)
        inside = interior & (rows > 0) & (rows < scan.shape[0] - 1)
        inside &= (columns > 0) & (columns < scan.shape[1] - 1)
        if not complete:
            inside &= map_coordinates(measured.astype(np.float32), (rows, columns), order=1) > 0.999
        warped = map_coordinates(spline, (rows, columns), order=3, mode="mirror", prefilter=False)
        gram = _cell_grams(regressors, warped, inside)
        coefficients = solve_gram(gram.sum(axis=(0, 1)))
        if coefficients[0] <= 0 or bend is not None:
            break
        warp = coefficients[NUISANCES:] / coefficients[0]
        increment = denormalise @ expm(np.einsum("k,kij->ij", warp, GENERATORS[: len(warp)])) @ normalise
        motion_px = apply_transform(increment, corners(shape)) - corners(shape)
        previous_px = step_px
        step_px = float(np.abs(motion_px).max())
        converged = step_px < tolerance_px
        diverges = not step_px < 0.5 * max(shape) or (iteration > 5 and step_px > 2 * previous_px)
        if converged or diverges or iteration == max_iterations:
            break
        matrix = matrix @ np.linalg.inv(increment)
        matrix /= matrix[2, 2]
    return Refinement(model, matrix, warped, gram, converged, bend)


def aligned_gram(aligned: Array, topography: Array, count: int, further: Sequence[Array] = ()) -> Array:
    """Return the inner products, as in ``Refinement.gram``, for a scan that is already aligned with the
    topography.

    Args:
        aligned: the scan on the layout's pixels, shape (ny, nx), NaN where not measured.
        topography: topography predicted from the layout, shape (ny, nx).
        count: number of generators of the warp: a value of ``LADDER``, or ``BENT_COUNT``.
        further: additional regressors, each of shape (ny, nx).
    """
    shape = topography.shape
    inside = interior_of(shape) & np.isfinite(aligned)
    regressors = np.concatenate([_regressors(topography, count), *(one[None] for one in further)])
    return _cell_grams(regressors, np.where(inside, aligned, 0.0).astype(np.float32), inside)


def in_blocks(gram: Array) -> Array:
    """Sum the inner products over blocks of two by two cells. The result has shape (blocks_y, blocks_x, k,
    k).

    An error of the predicted topography extends over one or two printed features. Blocks of this size are
    large enough that the errors of different blocks can be taken as independent.
    """
    starts = [np.linspace(0, n, max(1, n // 2) + 1).astype(int)[:-1] for n in gram.shape[:2]]
    return np.add.reduceat(np.add.reduceat(gram, starts[0], axis=0), starts[1], axis=1)


def solve_gram(gram: Array) -> Array:
    """Return the coefficients of the least-squares fit of the regressors to the scan, shape (…, k - 1).

    ``gram`` contains the inner products of the regressors and, last, the scan. Its shape is (…, k, k).
    """
    normal, right = gram[..., :-1, :-1], gram[..., :-1, -1]
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", normal), 1e-300))
    # If the layout does not determine a coefficient, a ridge term keeps this coefficient near zero. The term
    # is as small as the float32 precision of the regressors.
    scaled = normal / (scale[..., :, None] * scale[..., None, :]) + 1e-7 * np.eye(normal.shape[-1])
    return np.linalg.solve(scaled, (right / scale)[..., None])[..., 0] / scale


def residual_energy(gram: Array, coefficients: Array) -> Array:
    """Return the sum of squared residuals of a fit, from its inner products of shape (…, k, k) and its
    coefficients of shape (…, k - 1).
    """
    extended = np.concatenate([coefficients, -np.ones((*coefficients.shape[:-1], 1))], axis=-1)
    return np.einsum("...i,...ij,...j->...", extended, gram, extended)


def corner_motion_px(coefficients: Array, shape: Shape, points: Array) -> Array:
    """Return the displacements of points under a fitted warp, in layout pixels.

    Args:
        coefficients: coefficients as returned by ``solve_gram``, shape (…, k - 1).
        shape: shape (ny, nx) of the layout.
        points: positions (x, y) in layout pixels, shape (n, 2).

    Returns:
        Displacements along x and y, shape (…, n, 2). They are not finite where the fitted gain of the
        topography is 0.
    """
    normalise = normalisation(shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        warp = coefficients[..., NUISANCES:] / coefficients[..., :1]
    unit = apply_transform(normalise, points)
    flow = np.array([np.broadcast_arrays(*one) for one in flows(warp.shape[-1], *unit.T)])
    return np.einsum("...k,kdn->...nd", warp, flow) / normalise[0, 0]


def interior_of(shape: Shape, border_px: int = BORDER_PX) -> Array:
    """Return a bool mask of shape (ny, nx) that is false in a border along all sides and true elsewhere.

    The border is ``border_px`` wide, but not wider than a sixteenth of the shorter side.
    """
    border = min(border_px, min(shape) // 16)
    return np.pad(np.ones([n - 2 * border for n in shape], bool), border)


def _regressors(topography: Array, count: int) -> Array:
    """Return the regressors as an array of shape (7 + count, ny, nx).

    They are the topography, the six terms of the quadratic background, and the change of the topography under
    each of the ``count`` generators of the warp.
    """
    shape = topography.shape
    change = changes(topography.astype(np.float32), count) / np.float32(normalisation(shape)[0, 0])
    centred = topography.astype(np.float32) - topography.mean()
    return np.stack([centred, *quadratic_basis(shape).astype(np.float32), *change])


def _cell_grams(regressors: Array, warped: Array, inside: Array) -> Array:
    ny, nx = warped.shape
    stack = np.concatenate([regressors, warped[None]])
    stack *= inside
    rows, columns = _cell_edges(ny), _cell_edges(nx)
    gram = np.empty((len(rows) - 1, len(columns) - 1, len(stack), len(stack)))
    for i, (top, bottom) in enumerate(pairwise(rows)):
        for j, (left, right) in enumerate(pairwise(columns)):
            # The sums use float64, so that the order in which BLAS adds does not change the result.
            cell = stack[:, top:bottom, left:right].reshape(len(stack), -1).astype(float)
            gram[i, j] = cell @ cell.T
    return gram


def _cell_edges(size: int) -> Array:
    return np.linspace(0, size, max(1, round(size / CELL_PX)) + 1).astype(int)
