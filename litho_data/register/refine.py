"""Refine a registration to sub-pixel accuracy by maximising the correlation of heights and topography.

Gauss-Newton steps in the inverse compositional form maximise the correlation between the scan and the
predicted topography. A warp, a gain and a quadratic background are fitted at the same time. G. D.
Evangelidis, E. Z. Psarakis, IEEE TPAMI 30 (2008), doi:10.1109/TPAMI.2008.113; S. Baker, I. Matthews, IJCV 56
(2004), doi:10.1023/B:VISI.0000011205.11775.fd.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from litho_data.foundation import Array, Shape
from litho_data.register.bend import Bend
from litho_data.register.flows import BENT_COUNT, GENERATORS, LADDER, Model, flows, normalisation
from litho_data.register.geometry import apply_transform, corners, warped_grid
from litho_data.register.topography import fill_gaps, quadratic_basis

NUISANCES = 7  # gain of the topography, then the six quadratic terms
_BACKGROUND_AND_SCAN = [1, 2, 3, 4, 5, 6, -1]
CELL_PX = 32
# Within this distance of the border, the blurred heights depend on the unknown surroundings of the print,
# such as bare ground or a neighbouring print.
BORDER_PX = 8
TOLERANCE_PX = 1e-3


@dataclass(frozen=True)
class Refinement:
    """A refined warp, whether it converged, and the data that determine its uncertainty.

    ``layout_to_scan`` is the 3×3 index matrix; for a scan with a ``bend``, it maps to the straightened scan.
    ``warped`` (ny, nx) float32 is the scan on the layout's pixels, with gaps filled. ``gram`` (cells_y,
    cells_x, k, k) contains inner products for every cell, whose sides are about ``CELL_PX`` pixels long.
    Their factors are the regressors (gain, background, warp) and, as the last one, the scan. These sums
    suffice to refit any part of the field.
    """

    model: Model
    layout_to_scan: Array
    warped: Array
    gram: Array
    converged: bool
    bend: Bend | None = None

    def blocks(self) -> Array:
        """Return ``gram``, summed over blocks by ``in_blocks``."""
        return in_blocks(self.gram)

    @property
    def background(self) -> Array:
        """Return the coefficients (6,) of the quadratic surface fitted along with the warp."""
        return solve_gram(self.gram.sum(axis=(0, 1)))[1:NUISANCES]

    @property
    def correlation(self) -> float:
        """Return the partial correlation of scan and topography, given the background.

        The correlation is 0 if the fitted gain is not positive.
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
    """Find the warp of this model that maximises the correlation of scan and topography.

    Args:
        scan: (ny, nx) smoothed heights, NaN where not measured.
        topography: (ny, nx) predicted topography.
        start: 3×3 index matrix from the layout to the scan; it must be a warp of the kind ``model``. Its
            error may be as large as the width of the structures.
        bend: bend of the scan. If it is given, ``start`` must be an affine map, and the warp and the bend are
            evaluated but not refined.
        max_iterations: largest number of Gauss-Newton steps; with 0, the start is only evaluated.
        tolerance_px: the iteration ends when a step moves every corner by less than this.
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
    """Return ``gram``, as in ``Refinement``, for a scan that is already aligned with the topography.

    Both are (ny, nx); the scan is NaN where not measured. ``count`` is the number of flows of the warp, see
    ``LADDER`` and ``BENT_COUNT``. ``further`` are additional regressors (ny, nx).
    """
    shape = topography.shape
    inside = interior_of(shape) & np.isfinite(aligned)
    regressors = np.concatenate([_regressors(topography, count), *(one[None] for one in further)])
    return _cell_grams(regressors, np.where(inside, aligned, 0.0).astype(np.float32), inside)


def in_blocks(gram: Array) -> Array:
    """Sum the inner products over blocks of two by two cells; the result is (blocks_y, blocks_x, k, k).

    Errors of the topography extend over one or two features. A block is therefore the smallest area that
    counts as independent.
    """
    starts = [np.linspace(0, n, max(1, n // 2) + 1).astype(int)[:-1] for n in gram.shape[:2]]
    return np.add.reduceat(np.add.reduceat(gram, starts[0], axis=0), starts[1], axis=1)


def solve_gram(gram: Array) -> Array:
    """Return the coefficients of the least-squares fit of the regressors to the scan, from inner products.

    The inner products have the shape (…, k, k).
    """
    normal, right = gram[..., :-1, :-1], gram[..., :-1, -1]
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", normal), 1e-300))
    # A ridge at the float32 precision of the regressors sets coefficients to zero that the layout does not
    # determine.
    scaled = normal / (scale[..., :, None] * scale[..., None, :]) + 1e-7 * np.eye(normal.shape[-1])
    return np.linalg.solve(scaled, (right / scale)[..., None])[..., 0] / scale


def residual_energy(gram: Array, coefficients: Array) -> Array:
    """Return the sum of squared residuals for given coefficients and inner products (…, k, k)."""
    extended = np.concatenate([coefficients, -np.ones((*coefficients.shape[:-1], 1))], axis=-1)
    return np.einsum("...i,...ij,...j->...", extended, gram, extended)


def corner_motion_px(coefficients: Array, shape: Shape, points: Array) -> Array:
    """Return the displacements (…, n, 2) of points, in layout pixels, under the warp of fitted coefficients
    (…, k).

    The points are (n, 2). The result is not finite where the fitted gain of the topography is 0.
    """
    normalise = normalisation(shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        warp = coefficients[..., NUISANCES:] / coefficients[..., :1]
    unit = apply_transform(normalise, points)
    flow = np.array([np.broadcast_arrays(*one) for one in flows(warp.shape[-1], *unit.T)])
    return np.einsum("...k,kdn->...nd", warp, flow) / normalise[0, 0]


def interior_of(shape: Shape, border_px: int = BORDER_PX) -> Array:
    """Return a mask (ny, nx) of the pixels that do not lie in the border."""
    border = min(border_px, min(shape) // 16)
    return np.pad(np.ones([n - 2 * border for n in shape], bool), border)


def _regressors(topography: Array, count: int) -> Array:
    """Return the regressors: the topography, the quadratic background, and the change of the topography under
    each generator of the warp.

    The shape is (7 + count, ny, nx).
    """
    shape = topography.shape
    scale = normalisation(shape)[0, 0]
    gradient_y, gradient_x = np.gradient(topography.astype(np.float32))
    y = ((np.arange(shape[0]) - (shape[0] - 1) / 2) * scale).astype(np.float32)[:, None]
    x = ((np.arange(shape[1]) - (shape[1] - 1) / 2) * scale).astype(np.float32)[None, :]
    change = [
        (along_x * gradient_x + along_y * gradient_y) / np.float32(scale)
        for along_x, along_y in flows(count, x, y)
    ]
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
            # The sums use float64, because the result must not depend on the order in which BLAS adds.
            cell = stack[:, top:bottom, left:right].reshape(len(stack), -1).astype(float)
            gram[i, j] = cell @ cell.T
    return gram


def _cell_edges(size: int) -> Array:
    return np.linspace(0, size, max(1, round(size / CELL_PX)) + 1).astype(int)
