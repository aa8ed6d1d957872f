"""Refine a registration from coarse to fine resolution, and estimate the blur of the print."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from litho_data.foundation import Array, Shape
from litho_data.register.bend import Bend
from litho_data.register.flows import LADDER, Model
from litho_data.register.geometry import apply_transform, centre, corners, linear_part, warped_grid
from litho_data.register.refine import TOLERANCE_PX, Refinement, refine, residual_energy, solve_gram
from litho_data.register.topography import (
    fill_gaps,
    pearson,
    predicted_topography,
    smooth_measured,
)

SCAN_BLUR_PX = 1.0
BLURS_PX = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 15.0)
LEVELS = (4, 2)
SMALLEST_LEVEL_PX = 48


@dataclass(frozen=True)
class FineFit:
    """A refined warp, with the two images that the refinement compared. The images are the smoothed scan and
    the topography predicted from the layout with a Gaussian blur of sigma ``blur_px``.
    """

    refinement: Refinement
    scan: Array
    topography: Array
    blur_px: float


def refine_pyramid(
    scan: Array,
    layout_level: Array,
    start: Array,
    model: Model,
    *,
    tolerance_px: float = TOLERANCE_PX,
) -> FineFit:
    """Refine a coarse warp at a quarter of the resolution, then at half of it, then at full resolution.

    Args:
        scan: oriented heights at the layout's pitch, with the bow removed, shape (ny, nx), NaN where not
            measured.
        layout_level: integer levels, shape (ny, nx).
        start: the coarse warp, a 3×3 matrix from pixel indices of the layout to pixel indices of the scan.
        model: the kind of warp. At reduced resolution, an affine map is fitted in place of a homography.
        tolerance_px: tolerance of the refinement at full resolution.

    If the fit at full resolution does not converge, the result contains the coarse warp and is marked as not
    converged.
    """
    low_model: Model = "affine" if model == "homography" else model
    coarse = project_to_model(start, low_model, layout_level.shape)
    matrix = _from_coarse_to_fine(scan, layout_level, coarse, low_model)
    smooth_scan = _smooth(scan, SCAN_BLUR_PX)
    blur_px = match_blur(smooth_scan, layout_level, matrix)
    topography = predicted_topography(layout_level, blur_px)
    refinement = refine(smooth_scan, topography, matrix, model, tolerance_px=tolerance_px)
    if not refinement.converged:
        refinement = refine(smooth_scan, topography, coarse, model, max_iterations=0)
    return FineFit(refinement, smooth_scan, topography, blur_px)


def _from_coarse_to_fine(scan: Array, layout_level: Array, matrix: Array, model: Model) -> Array:
    """Refine the warp, first at a quarter of the resolution and then at half of it."""
    for factor, small_scan, small_topography in reduced_levels(scan, layout_level):
        scale = np.diag([1.0 / factor, 1.0 / factor, 1.0])
        start = scale @ matrix @ np.linalg.inv(scale)
        found = refine(small_scan, small_topography, start, model, tolerance_px=0.02)
        if found.converged:
            matrix = np.linalg.inv(scale) @ found.layout_to_scan @ scale
    return matrix


def reduced_levels(scan: Array, layout_level: Array) -> Iterator[tuple[int, Array, Array]]:
    """Yield (factor, scan, predicted topography), with both images first at a quarter of the resolution and
    then at half of it.

    ``factor`` is 4 or 2. A resolution at which the images would be too small is skipped.
    """
    for factor in LEVELS:
        if min(*layout_level.shape, *scan.shape) < factor * SMALLEST_LEVEL_PX:
            continue
        # A coarse fit may be wrong by a few pixels. The extra blur makes the refinement converge in spite of
        # such an error.
        small_scan = _smooth(scan, factor)[::factor, ::factor]
        yield factor, small_scan, predicted_topography(layout_level, 1.5 * factor)[::factor, ::factor]


def match_blur(
    smooth_scan: Array, layout_level: Array, layout_to_scan: Array, bend: Bend | None = None
) -> float:
    """Return the sigma, in layout pixels, of the Gaussian blur that makes the topography correlate best with
    the aligned scan.
    """
    from scipy.ndimage import map_coordinates

    grid = warped_grid(layout_to_scan, layout_level.shape, bend)
    # Every second row and column is enough to compare blurs of half a pixel and more.
    rows, columns = grid[0][::2, ::2], grid[1][::2, ::2]
    warped = map_coordinates(fill_gaps(smooth_scan), (rows, columns), order=1, cval=np.nan)
    valid = np.isfinite(warped)
    if valid.sum() < 16:
        return SCAN_BLUR_PX
    scores: list[float] = []
    for blur_px in BLURS_PX:
        predicted = predicted_topography(layout_level, blur_px)[::2, ::2]
        scores.append(pearson(warped[valid], predicted[valid]))
        if len(scores) > 1 and scores[-1] < scores[-2]:
            break
    return BLURS_PX[int(np.argmax(scores))]


def project_to_model(matrix: Array, model: Model, shape: Shape) -> Array:
    """Return the warp of the kind ``model`` that approximates a given warp best.

    If ``model`` is affine, the result agrees with the given warp to first order at the centre of the field. A
    warp of a simpler kind is fitted to the positions to which the given warp maps the four corners.
    """
    if model == "homography":
        return matrix
    if model == "affine":
        middle = centre(shape)
        return _about(linear_part(matrix, middle), middle, apply_transform(matrix, middle[None])[0])
    points = corners(shape)
    moved = apply_transform(matrix, points)
    source, target = (p[:, 0] + 1j * p[:, 1] for p in (points - points.mean(0), moved - moved.mean(0)))
    turn = np.vdot(source, target) / np.vdot(source, source)
    if model == "translation":
        turn = np.complex128(1.0)
    elif model == "euclidean":
        turn = turn / abs(turn)
    linear = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    return _about(linear, points.mean(0), moved.mean(0))


def _about(linear: Array, point: Array, image: Array) -> Array:
    """Return the affine map that has the given linear part and maps ``point`` to ``image``."""
    matrix = np.eye(3)
    matrix[:2, :2] = linear
    matrix[:2, 2] = image - linear @ point
    return matrix


def _smooth(scan: Array, sigma_px: float) -> Array:
    """Smooth the scan where it was measured, and keep NaN in its gaps."""
    return np.where(np.isfinite(scan), smooth_measured(scan, sigma_px), np.nan)


STANDARD_ERRORS = 3.0


def climb(fine: FineFit) -> FineFit:
    """Fit every kind of warp. Return the fit of the simplest kind that predicts held-out blocks as well as
    every more general kind.

    Args:
        fine: a converged affine fit. The fit of every kind starts from the warp of this kind that
            approximates the affine warp best.

    A more general kind counts as better only if it lowers the residual energy in held-out blocks, and the
    mean decrease over the blocks exceeds three times its standard error.
    """
    shape = fine.topography.shape
    start = fine.refinement.layout_to_scan
    fits = [
        refine(fine.scan, fine.topography, project_to_model(start, model, shape), model) for model in LADDER
    ]
    energies = [held_out_energy(fit) for fit in fits]
    for rung, energy in enumerate(energies):
        if not any(_pays(energy, higher) for higher in energies[rung + 1 :]):
            break
    return replace(fine, refinement=fits[rung])


def held_out_energy(refinement: Refinement) -> Array:
    """Return, for every block, the residual energy (sum of squared residuals) of a fit that did not use the
    block. The result has shape (blocks,).

    The blocks are divided into four folds, each spread over the whole field. The fit for a block uses the
    blocks of the other three folds.
    """
    blocks = refinement.blocks()
    rows, columns = np.indices(blocks.shape[:2])
    fold = 2 * (rows % 2) + columns % 2
    energy = np.empty(blocks.shape[:2])
    for k in np.unique(fold):
        energy[fold == k] = residual_energy(blocks[fold == k], solve_gram(blocks[fold != k].sum(axis=0)))
    return energy.ravel()


def _pays(low: Array, high: Array) -> bool:
    gain = low - high
    return float(gain.mean()) > STANDARD_ERRORS * float(gain.std(ddof=1)) / np.sqrt(len(gain))
