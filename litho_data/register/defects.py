"""Find areas where a scan does not show the print: dust, collapsed or missing parts, lifted film.

Such an area can shift a least-squares warp by whole pixels. A defect is a connected area in which no
prediction based on the layout fits the heights: the misfit is many times the usual one.
"""

from dataclasses import replace

import numpy as np

from litho_data.foundation import Array
from litho_data.register.flows import Model
from litho_data.register.geometry import apply_transform, corners, nearest, overlap_of, warped_grid
from litho_data.register.pyramid import FineFit, refine_pyramid
from litho_data.register.refine import BORDER_PX
from litho_data.register.topography import fill_gaps, quadratic_basis

# Misfits in units of their robust standard deviation. An area whose misfit exceeds the first value is
# suspected, and extends to where the misfit falls to the second value. The area is a defect if its misfit
# reaches the third value after the warp is fitted without the area. Printer effects other than a Gaussian
# blur stay below the third value; on the measured prints they reach 13.5.
SUSPECT_SIGMA, EDGE_SIGMA, DEFECT_SIGMA = 8.0, 3.0, 16.0
SMALLEST_AREA_PX = 30
MARGIN_PX, POCKET_PX = 4, 12
# If defects cover more than this share of the field, no main surface remains, and the whole print is
# doubtful.
LARGEST_SHARE = 0.45
_KNOTS = 8
_EVERY = 3
_FEWEST_PX = 60
# Smallest sigma, as a share of the standard deviation of the scan.
_LEAST_SIGMA = 1 / 32
_ROUNDS = 6
_SETTLED_PX = 0.02
# Pixels at the edge of a mask enter and leave the fit, so its steps do not fall below a thousandth of a
# pixel.
_TOLERANCE_PX = 0.01
# A suspected area of at least this share of the field may have distorted the fit so much that the area's own
# misfit looks small.
_WORTH_A_FIT = 0.005
# Below this correlation, the fit of the whole print may be wrong. The measured prints reach 0.945 or more.
_SUSPICIOUS = 0.9
_MAD_PER_SIGMA = 0.6745
_TUKEY = 4.685
_PASSES = 8


def refine_around_defects(
    plain: FineFit, scan: Array, layout_level: Array, start: Array, model: Model
) -> tuple[FineFit, Array | None]:
    """Find defects, and refit the warp without them.

    Return the fit and a mask of the defects, bool (ny, nx) on the layout's pixels. If there are no defects,
    return the plain fit and None.

    Every round finds the defects under the last warp and fits a new warp to the other pixels, starting from
    the robust coarse warp. The rounds end when the corners of the warp no longer move.

    Args:
        plain: ``refine_pyramid(scan, layout_level, start, model)``.
        scan, layout_level, start, model: as in ``refine_pyramid``.
    """
    fine, defects = plain, None
    for attempt in range(_ROUNDS):
        found, largest_sigma = find_defects(plain.scan, fine)
        if not found.any() and attempt == 0 and plain.refinement.correlation < _SUSPICIOUS:
            # A large defect may have shifted the plain fit so far that the whole print does not match.
            fine = replace(plain, refinement=replace(plain.refinement, layout_to_scan=start))
            found, largest_sigma = find_defects(plain.scan, fine)
        if not found.any() or (largest_sigma < DEFECT_SIGMA and found.mean() < _WORTH_A_FIT):
            return plain, None
        warp = fine.refinement.layout_to_scan
        masked = without_defects(scan, found, warp)
        fine = refine_pyramid(masked, layout_level, start, model, tolerance_px=_TOLERANCE_PX)
        defects = found
        # Without true defects, the remaining pixels must fit better. If the warp shifts every edge, all edges
        # are suspected, and little more than flat ground remains.
        if not fine.refinement.converged or fine.refinement.correlation < plain.refinement.correlation:
            return plain, None
        ends = corners(layout_level.shape)
        moved = apply_transform(fine.refinement.layout_to_scan, ends) - apply_transform(warp, ends)
        if np.abs(moved).max() < _SETTLED_PX:
            break
    return (fine, defects) if largest_sigma >= DEFECT_SIGMA else (plain, None)


def find_defects(scan: Array, fine: FineFit) -> tuple[Array, float]:
    """Return a mask of the places where the scan does not show the print, widened by a margin. Also return
    the largest misfit.

    The misfit is the scan on the layout's pixels, minus a free function of the predicted topography
    (piecewise linear, 8 knots) and a quadratic background, fitted with Tukey's weights. A defect is a
    connected area of at least 30 pixels whose misfit exceeds 3 sigma everywhere and 8 sigma somewhere.

    Args:
        scan: (ny, nx) smoothed heights, including the defects, in the same frame as ``fine.scan``.
        fine: the fit of the warp, which may exclude some defects.

    Returns:
        bool (ny, nx) on the layout's pixels, and the misfit in units of its robust standard deviation.
    """
    from scipy.ndimage import binary_dilation, binary_erosion, binary_fill_holes, label, sum_labels

    nowhere = np.zeros(fine.topography.shape, bool), 0.0
    misfit = _misfit(scan, fine)
    if misfit is None:
        return nowhere
    # Without noise, the whole misfit may come from edges. Sigma therefore has a lower limit, so that a misfit
    # that is small compared with the print does not count as a defect.
    sigma = max(np.nanmedian(np.abs(misfit)) / _MAD_PER_SIGMA, _LEAST_SIGMA * np.nanstd(scan))
    size = np.nan_to_num(np.abs(misfit) / sigma)
    if size.max() <= SUSPECT_SIGMA:
        return nowhere
    regions, count = label(size > EDGE_SIGMA)
    index = np.arange(1, count + 1)
    suspect = sum_labels(size > SUSPECT_SIGMA, regions, index) > 0
    large = sum_labels(regions > 0, regions, index) >= SMALLEST_AREA_PX
    found = np.isin(regions, index[suspect & large])
    if not found.any() or found.mean() > LARGEST_SHARE:
        return nowhere
    # Inside a missing part, some ground may have the right height by chance. Such pixels are marked too.
    whole = binary_fill_holes(binary_dilation(found, iterations=MARGIN_PX + POCKET_PX))
    return binary_erosion(whole, iterations=POCKET_PX, border_value=1), float(size[found].max())


def without_defects(scan: Array, defects: Array, layout_to_scan: Array) -> Array:
    """Return a copy of the scan (ny, nx) with NaN at the defects, which are given on the layout's pixels."""
    rows, columns = warped_grid(np.linalg.inv(layout_to_scan), scan.shape)
    ny, nx = defects.shape
    inside = (rows > -0.5) & (rows < ny - 0.5) & (columns > -0.5) & (columns < nx - 0.5)
    return np.where(inside & nearest(defects, rows, columns), np.nan, scan)


def _misfit(scan: Array, fine: FineFit) -> Array | None:
    """Return the scan minus the part that the layout explains, (ny, nx), on the layout's pixels.

    The result is NaN at the border and where nothing was measured. It is None if the scan shows almost
    nothing of the layout.
    """
    from scipy.ndimage import map_coordinates

    topography, found = fine.topography, fine.refinement
    shape = topography.shape
    seen = overlap_of(found.layout_to_scan, shape, np.isfinite(scan), found.bend)
    places = warped_grid(found.layout_to_scan, shape, found.bend)
    warped = np.where(seen, map_coordinates(fill_gaps(scan), places, order=1, mode="nearest"), np.nan)
    sparse = (slice(None, None, _EVERY),) * 2
    seen = np.isfinite(warped[sparse])
    if seen.sum() < _FEWEST_PX:
        return None
    knots, surfaces = np.linspace(topography.min(), topography.max(), _KNOTS), quadratic_basis(shape)[1:]
    hats = [np.interp(topography[sparse][seen], knots, hat) for hat in np.eye(_KNOTS)]
    design = np.stack([*hats, *surfaces[:, *sparse][:, seen]], axis=1)
    response, background = np.split(_robust(design, warped[sparse][seen]), [_KNOTS])
    misfit = warped - np.interp(topography, knots, response) - np.einsum("k,kyx->yx", background, surfaces)
    inner = (slice(BORDER_PX, -BORDER_PX),) * 2
    framed = np.full(shape, np.nan)
    framed[inner] = misfit[inner]
    return framed


def _robust(design: Array, values: Array) -> Array:
    """Fit coefficients with Tukey's weights, after some passes with weights that fall off slowly."""
    weights = np.ones(len(values))
    coefficients = np.zeros(design.shape[1])
    for step in range(_PASSES):
        weighted = design * weights[:, None]
        normal = weighted.T @ design + 1e-9 * len(values) * np.eye(design.shape[1])
        coefficients = np.linalg.solve(normal, weighted.T @ values)
        residual = np.abs(values - design @ coefficients)
        scale = max(float(np.median(residual)) / _MAD_PER_SIGMA, 1e-12)
        if step < _PASSES // 2:
            weights = 1 / np.maximum(residual / scale, 1.0)
        else:
            weights = np.clip(1 - (residual / (_TUKEY * scale)) ** 2, 0, None) ** 2
    return coefficients
