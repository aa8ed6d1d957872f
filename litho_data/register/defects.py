"""Find defects, i.e. areas where a scan does not show the print because of dust, collapsed or missing parts,
or lifted film.

Such an area can shift a least-squares fit of the warp by whole pixels. A defect is found as a connected area
where heights and prediction differ by many times their usual difference.
"""

from dataclasses import replace

import numpy as np

from litho_data.foundation import Array
from litho_data.register.flows import Model
from litho_data.register.geometry import apply_transform, corners, nearest, overlap_of, warped_grid
from litho_data.register.pyramid import FineFit, refine_pyramid
from litho_data.register.refine import BORDER_PX
from litho_data.register.topography import fill_gaps, quadratic_basis

# Limits of the misfit (heights minus prediction), in units of its robust standard deviation. An area is
# suspected if its misfit exceeds the first value somewhere. The area extends to where the misfit falls to the
# second value. The area is a defect if its misfit still reaches the third value after the warp has been
# fitted without the area. Some effects of the printer are not described by a Gaussian blur. On the measured
# prints, their misfit reaches 13.5, which is below the third value.
SUSPECT_SIGMA, EDGE_SIGMA, DEFECT_SIGMA = 8.0, 3.0, 16.0
SMALLEST_AREA_PX = 30
MARGIN_PX, POCKET_PX = 4, 12
# If suspected areas cover more than this share of the field, they cannot be distinguished from the print, and
# no area is marked as a defect.
LARGEST_SHARE = 0.45
_KNOTS = 8
_EVERY = 3
_FEWEST_PX = 60
# Lower limit of sigma, the robust standard deviation of the misfit, as a share of the standard deviation of
# the scan's heights.
_LEAST_SIGMA = 1 / 32
_ROUNDS = 6
_SETTLED_PX = 0.02
# Tolerance of the fit that leaves out masked pixels. From step to step, pixels at the edge of the mask enter
# or leave this fit, so its steps do not become smaller than a thousandth of a pixel.
_TOLERANCE_PX = 0.01
# Suspected areas that cover at least this share of the field may have distorted the warp so much that the
# misfit in them is small. The warp is therefore fitted without these areas even if their misfit is below the
# third limit.
_WORTH_A_FIT = 0.005
# If the correlation is below this, the fit to the whole print may be wrong. The measured prints reach 0.945
# or more.
_SUSPICIOUS = 0.9
_MAD_PER_SIGMA = 0.6745
_TUKEY = 4.685
_PASSES = 8


def refine_around_defects(
    plain: FineFit, scan: Array, layout_level: Array, start: Array, model: Model
) -> tuple[FineFit, Array | None]:
    """Find defects, and fit the warp again to the pixels outside the defects.

    This is done in several rounds. Each round finds the defects with the warp of the round before, and fits a
    new warp to all other pixels, starting from the coarse warp ``start``. The rounds end when the positions
    of the corners no longer change, or after six rounds.

    Args:
        plain: the fit to all pixels, ``refine_pyramid(scan, layout_level, start, model)``.
        scan, layout_level, start, model: as in ``refine_pyramid``.

    Returns:
        The fit to the pixels outside the defects, and a bool mask of shape (ny, nx) that is true at the
        layout pixels that are defects. The result is ``plain`` and None if there are no defects, or if the
        fit without them does not converge or has a lower correlation than ``plain``.
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
        # If the areas are true defects, the other pixels now fit better. If the warp is wrong and shifts
        # every edge, all edges are suspected. Little more than flat ground then remains for the fit, and the
        # correlation falls.
        if not fine.refinement.converged or fine.refinement.correlation < plain.refinement.correlation:
            return plain, None
        ends = corners(layout_level.shape)
        moved = apply_transform(fine.refinement.layout_to_scan, ends) - apply_transform(warp, ends)
        if np.abs(moved).max() < _SETTLED_PX:
            break
    return (fine, defects) if largest_sigma >= DEFECT_SIGMA else (plain, None)


def find_defects(scan: Array, fine: FineFit) -> tuple[Array, float]:
    """Find the areas where the scan does not show the print, and the largest misfit in these areas.

    The misfit is the height of the scan, on the layout's pixels, minus a prediction. The prediction is the
    sum of a piecewise linear function of the predicted topography (with 8 knots) and a quadratic background.
    Both are fitted with Tukey's weights. Sigma is the robust standard deviation of the misfit. The function
    finds every connected area of at least 30 pixels in which the misfit exceeds 3 sigma everywhere and 8
    sigma somewhere. If such areas cover more than 45 % of the field, none of them is returned.

    Args:
        scan: smoothed heights with shape (ny, nx), in the same frame as ``fine.scan``. Heights at defects are
            included.
        fine: the fit of the warp. Defects that were found earlier may have been left out of this fit.

    Returns:
        A bool mask of shape (ny, nx) that is true at the layout pixels in the areas, each widened by a
        margin; and the largest misfit in the areas, in units of sigma.
    """
    from scipy.ndimage import binary_dilation, binary_erosion, binary_fill_holes, label, sum_labels

    nowhere = np.zeros(fine.topography.shape, bool), 0.0
    misfit = _misfit(scan, fine)
    if misfit is None:
        return nowhere
    # In a scan without noise, only edges may have a misfit, and the robust standard deviation would be tiny.
    # Sigma therefore has a lower limit, so that a misfit that is small compared with the print is no defect.
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
    # Inside an area where the print is missing, some pixels may have the right height by chance. These pixels
    # are marked as well.
    whole = binary_fill_holes(binary_dilation(found, iterations=MARGIN_PX + POCKET_PX))
    return binary_erosion(whole, iterations=POCKET_PX, border_value=1), float(size[found].max())


def without_defects(scan: Array, defects: Array, layout_to_scan: Array) -> Array:
    """Return a copy of the scan with NaN at the defects.

    ``scan`` has shape (ny, nx), and ``defects`` is a bool mask on the layout's pixels. ``layout_to_scan`` is
    the 3×3 matrix from pixel indices of the layout to pixel indices of the scan.
    """
    rows, columns = warped_grid(np.linalg.inv(layout_to_scan), scan.shape)
    ny, nx = defects.shape
    inside = (rows > -0.5) & (rows < ny - 0.5) & (columns > -0.5) & (columns < nx - 0.5)
    return np.where(inside & nearest(defects, rows, columns), np.nan, scan)


def _misfit(scan: Array, fine: FineFit) -> Array | None:
    """Return the part of the scan's heights that the layout does not explain, on the pixels of the layout.

    The result is NaN at the border of the layout and where nothing was measured. It is None if the scan
    covers almost nothing of the layout.
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
    """Return coefficients fitted robustly, by least squares with repeatedly updated weights.

    In the first half of the passes, the weights fall slowly as the residual grows. In the second half, they
    are Tukey's weights, which are zero for large residuals.
    """
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
