"""Register scans whose scanner bends the image or creeps. No straight warp (a warp without bend or creep)
fits such scans.

A bend displaces the image by a quadratic function of position. A scanner creeps while it is still settling.
Creep displaces whole scan lines along x and y. The displacement is a smooth function of the position along
the slow axis only. A straight warp absorbs the linear part of creep. The nonlinear part, about a tenth of the
creep, distorts the image of the print, and creep can be detected only by this distortion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from litho_data.foundation import Array
from litho_data.register.bend import CREEP_DEGREE, Bend, fit_bent_affine
from litho_data.register.geometry import apply_transform, lattice, warped_grid
from litho_data.register.pyramid import FineFit, match_blur, project_to_model, reduced_levels
from litho_data.register.refine import BORDER_PX, interior_of, refine
from litho_data.register.topography import fill_gaps, predicted_topography, quadratic_basis

Curve = int | Literal["quadratic"] | None
"""The distortion that is fitted in addition to an affine map. The number of the slow axis (0 = x, 1 = y)
stands for creep along this axis, ``quadratic`` stands for a bend, and None for no distortion.
"""
# At full resolution, only every second row and column is used, because these locate the print as accurately
# as all rows and columns do.
_EVERY = 2
_ITERATIONS = 30
_SETTLED_PX = 5e-3
_FOLD_PX = 64
# Creep is accepted if the p-value of the test on held-out blocks is below this value. The p-value is the
# probability that, in a scan without creep, the blocks favour creep this clearly by chance.
_CHANCE = 0.01
_BACKGROUND = 6


def refine_curved(scan: Array, layout_level: Array, straight: FineFit, curve: Curve) -> FineFit | None:
    """Refine a straight warp by adding a bend or creep.

    Return None if the fit fails, or if creep was fitted and the held-out blocks do not confirm it.

    Creep displaces the image, along x and along y, by polynomials of degree 6 in the coordinate along the
    slow axis. The two polynomials add ten coefficients to the six of the affine map. Creep is accepted only
    if it predicts held-out blocks better than the straight warp does. For this test, the field is divided
    into squares with sides of 64 px. The squares form two halves, like the black and the white squares of a
    chequerboard. The warps with and without creep are fitted to each half, and each fit predicts the other
    half.

    Args:
        scan, layout_level: as in ``refine_pyramid``.
        straight: the result of ``refine_pyramid``, from which the refinement starts at a quarter of the
            resolution. The position error of this result may therefore be as large as the width of the
            printed structures at a quarter of the resolution.
        curve: the distortion to fit: ``quadratic`` for a bend. For creep, it is the number (0 = x, 1 = y) of
            the oriented scan's slow axis, which runs across the scan lines.
    """
    shape = layout_level.shape
    affine = project_to_model(straight.refinement.layout_to_scan, "affine", shape)
    start = affine, Bend.none_yet(scan.shape)
    found = _from_coarse_to_fine(scan, layout_level, start, curve)
    blur_px = match_blur(straight.scan, layout_level, *found)
    topography = predicted_topography(layout_level, blur_px)
    level = _without_own_bow(straight.scan, topography, warped_grid(found[0], shape, found[1]))
    case, apart = _Images(level, topography, _EVERY), np.diag([_EVERY, _EVERY, 1.0])
    whole = case.fit(found[0] @ apart, found[1], curve, case.everywhere)
    if whole is None or (
        curve != "quadratic" and not _is_confirmed(case, (affine @ apart, start[1]), whole, curve)
    ):
        return None
    matrix, bend = whole[0] @ np.linalg.inv(apart), whole[1]
    refinement = replace(refine(level, topography, matrix, "affine", bend=bend), converged=True)
    return FineFit(refinement, level, topography, blur_px)


def _from_coarse_to_fine(
    scan: Array, layout_level: Array, found: tuple[Array, Bend], curve: Curve
) -> tuple[Array, Bend]:
    """Refine the affine map and the bend, first at a quarter of the resolution and then at half of it."""
    for factor, small_scan, small_topography in reduced_levels(scan, layout_level):
        small = _Images(small_scan, small_topography)
        scale = np.diag([1.0 / factor, 1.0 / factor, 1.0])
        shrunk = scale @ found[0] @ np.linalg.inv(scale), found[1].scaled(1 / factor)
        refined = small.fit(*shrunk, curve, small.everywhere)
        if refined is not None:
            found = np.linalg.inv(scale) @ refined[0] @ scale, refined[1].scaled(factor)
    return found


def _without_own_bow(scan: Array, topography: Array, grid: tuple[Array, Array]) -> Array:
    """Subtract the bow of the scan, i.e. the quadratic surface in its heights that the topography does not
    explain.

    The bow is quadratic in the scan's frame. It is not quadratic in the layout's frame, where the scan is
    straightened. A quadratic background in the layout's frame could not describe the bow, and would distort
    the fit of the bend. If the print itself contains a quadratic surface that the topography does not
    explain, this surface is subtracted as well.
    """
    from scipy.ndimage import map_coordinates

    basis = quadratic_basis(scan.shape)
    places = tuple(one[::3, ::3] for one in grid)
    warped = map_coordinates(fill_gaps(scan), places, order=1, cval=np.nan)
    seen = np.isfinite(warped)
    surfaces = [map_coordinates(one, places, order=1)[seen] for one in basis]
    design = np.stack([topography[::3, ::3][seen], *surfaces], axis=1)
    coefficients, *_ = np.linalg.lstsq(design, warped[seen], rcond=None)
    return scan - np.einsum("k,kyx->yx", coefficients[1:], basis)


def _is_confirmed(
    case: _Images, straight: tuple[Array, Bend], whole: tuple[Array, Bend], curve: Curve
) -> bool:
    from scipy.stats import wilcoxon

    ny, nx = case.everywhere.shape
    row, column = np.arange(ny) * _EVERY // _FOLD_PX, np.arange(nx) * _EVERY // _FOLD_PX
    block = row[:, None] * (column[-1] + 1) + column
    first = (row[:, None] + column) % 2 == 0
    gains = []
    for fold in (first, ~first):
        with_creep = case.fit(*whole, curve, fold)
        without = case.fit(*straight, None, fold)
        if with_creep is None or without is None:
            return False
        better = case.squares(*without, fold) - case.squares(*with_creep, fold)
        held_out = ~fold & np.isfinite(better)
        sums: Array = np.bincount(block[held_out], better[held_out], minlength=int(block.max()) + 1)
        gains.append(sums[np.unique(block[~fold])])
    # The squared misfit of each block is compared with and without creep in the warp. Creep fades along the
    # scan, so the misfit decreases strongly in only a few blocks. A rank test is used because it does not
    # depend on how strong these decreases are.
    gain = np.concatenate(gains)
    return bool(gain.any() and wilcoxon(gain, alternative="greater").pvalue < _CHANCE)


class _Images:
    """A scan and the topography with which it is compared. Warps can be fitted to any selection of the
    topography's pixels.
    """

    def __init__(self, scan: Array, topography: Array, every: int = 1):
        """Prepare the images. Only every ``every``-th row and column of the topography is used, and pixel
        indices of the layout count only these rows and columns.
        """
        from scipy.ndimage import spline_filter

        self._measured = np.isfinite(scan)
        self._spline = spline_filter(fill_gaps(scan), 3, output=np.float32, mode="mirror")
        steepness = np.gradient(topography.astype(float))
        self._gradient = [every * np.asarray(one)[::every, ::every] for one in reversed(steepness)]
        topography = topography[::every, ::every]
        shape = topography.shape
        self._surface = [topography - topography.mean(), *quadratic_basis(shape)]
        self.everywhere = interior_of(shape, BORDER_PX // every)

    def fit(self, matrix: Array, bend: Bend, curve: Curve, chosen: Array) -> tuple[Array, Bend] | None:
        """Fit an affine map and a bend or creep to the pixels in the mask ``chosen``, by Gauss-Newton steps.

        Return the matrix and the bend, or None if the steps do not converge.
        """
        y, x = (np.linspace(0, n - 1, 17) for n in self._measured.shape)
        points = lattice(y, x)
        for _ in range(_ITERATIONS):
            warped, (rows, columns), inside = self._warped(matrix, bend)
            inside &= chosen & self.everywhere
            flow = _flow(bend, columns[inside], rows[inside], curve)
            along = [gradient[inside] * one for gradient in self._gradient for one in flow]
            design = np.stack([*(one[inside] for one in self._surface), *along], axis=1)
            coefficients = _solve(design, warped[inside])
            if coefficients[0] <= 0:
                return None
            motion = coefficients[1 + _BACKGROUND :].reshape(2, -1) / coefficients[0]
            step_px = motion @ _flow(bend, points[:, 0], points[:, 1], curve)
            if not np.abs(step_px).max() < 0.2 * min(self._measured.shape):
                return None
            layout = apply_transform(np.linalg.inv(matrix), bend.straighten(points))
            degree = CREEP_DEGREE if isinstance(curve, int) else 2
            try:
                moved = fit_bent_affine(points, layout + step_px.T, bend.middle, bend.half, degree)
            except np.linalg.LinAlgError:
                return None
            matrix, bend = np.linalg.inv(moved[0]), moved[1]
            if np.abs(step_px).max() < _SETTLED_PX:
                return matrix, bend
        return None

    def squares(self, matrix: Array, bend: Bend, fitted: Array) -> Array:
        """Return the squared misfit (scan minus fitted topography and background) of every pixel for a given
        warp and bend.

        The gain and the background of the heights are fitted to the pixels in the mask ``fitted`` only. The
        misfit is NaN outside the scan.
        """
        warped, _, inside = self._warped(matrix, bend)
        design = np.stack(self._surface)
        chosen = inside & fitted
        coefficients = _solve(design[:, chosen].T, warped[chosen])
        misfit = warped - np.einsum("k,kyx->yx", coefficients, design)
        return np.where(inside & self.everywhere, misfit**2, np.nan)

    def _warped(self, matrix: Array, bend: Bend) -> tuple[Array, tuple[Array, Array], Array]:
        from scipy.ndimage import map_coordinates

        places = warped_grid(matrix, self.everywhere.shape, bend)
        warped = map_coordinates(self._spline, places, order=3, mode="mirror", prefilter=False)
        seen = map_coordinates(self._measured.astype(np.float32), places, order=1, cval=0.0) > 0.999
        return warped.astype(float), places, seen


def _flow(bend: Bend, x: Array, y: Array, curve: Curve) -> Array:
    """Return the terms of the displacement at the given points of the scan. The displacement along an axis is
    a weighted sum of these terms. They are 1, u, v, and the terms of the bend or the creep.
    """
    u, v = unit = bend.unit(x, y)
    flows = [np.ones_like(u), u, v]
    if curve == "quadratic":
        flows += [u * u, u * v, v * v]
    elif curve is not None:
        flows += list(np.polynomial.legendre.legvander(unit[curve], CREEP_DEGREE).T[2:])
    return np.stack(flows)


def _solve(design: Array, values: Array) -> Array:
    normal = design.T @ design
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    return np.linalg.solve(scaled, design.T @ values / scale) / scale
