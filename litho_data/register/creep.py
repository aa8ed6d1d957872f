"""Creep: the scanner is still settling, and the lines of a scan are displaced along its slow axis.

The displacement along both axes is a smooth function of the slow axis alone. A straight warp takes its linear
part; what remains bends the print by a tenth of the creep, without any other sign.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from litho_data.foundation.kinds import Array
from litho_data.register.bend import CREEP_DEGREE, Bend, fit_bent_affine
from litho_data.register.geometry import apply_transform, lattice, warped_grid
from litho_data.register.pyramid import FineFit, reduced_levels
from litho_data.register.refine import BORDER_PX, interior_of, refine
from litho_data.register.topography import fill_gaps, quadratic_basis

# Every second pixel of the layout in both directions places the print as well as all of them.
_EVERY = 2
_ITERATIONS = 12
_SETTLED_PX = 5e-3
_FOLD_PX = 64
# Largest probability that held-out blocks prefer the creep by chance.
_CHANCE = 0.01
_BACKGROUND = 6


def refine_with_creep(scan: Array, layout_level: Array, straight: FineFit, slow: int) -> FineFit | None:
    """The straight warp and a creep on top, or None if blocks held out of the fit do not prefer it.

    The displacement along x and y is a polynomial of degree 6 in the slow coordinate, ten numbers besides
    the affine. It is fitted to two halves of the field, squares of 64 px in a chequerboard, and each fit
    predicts the other half; so is the straight warp.

    Args:
        scan: (ny, nx) oriented heights at the layout's pitch, NaN where not measured.
        layout_level: (ny, nx) integer levels.
        straight: what ``refine_pyramid`` found.
        slow: axis of the oriented scan along which the lines follow each other, 0 = x, 1 = y.
    """
    straight_line = straight.refinement.layout_to_scan, Bend.none_yet(scan.shape)
    crept = straight_line
    for factor, small_scan, small_topography in reduced_levels(scan, layout_level):
        small = _Images(small_scan, small_topography)
        scale = np.diag([1.0 / factor, 1.0 / factor, 1.0])
        shrunk = scale @ crept[0] @ np.linalg.inv(scale), crept[1].scaled(1 / factor)
        found = small.fit(*shrunk, slow, small.everywhere)
        if found is not None:
            crept = np.linalg.inv(scale) @ found[0] @ scale, found[1].scaled(factor)
    case = _Images(straight.scan, straight.topography, _EVERY)
    apart = np.diag([_EVERY, _EVERY, 1.0])
    whole = case.fit(crept[0] @ apart, crept[1], slow, case.everywhere)
    if whole is None:
        return None
    if not _is_confirmed(case, (straight_line[0] @ apart, straight_line[1]), whole, slow):
        return None
    matrix, bend = whole[0] @ np.linalg.inv(apart), whole[1]
    refinement = refine(straight.scan, straight.topography, matrix, "affine", bend=bend, max_iterations=0)
    return replace(straight, refinement=replace(refinement, converged=True))


def _is_confirmed(case: _Images, straight: tuple[Array, Bend], whole: tuple[Array, Bend], slow: int) -> bool:
    from scipy.stats import wilcoxon

    ny, nx = case.everywhere.shape
    row, column = np.arange(ny) * _EVERY // _FOLD_PX, np.arange(nx) * _EVERY // _FOLD_PX
    block = row[:, None] * (column[-1] + 1) + column
    first = (row[:, None] + column) % 2 == 0
    gains = []
    for fold in (first, ~first):
        with_creep = case.fit(*whole, slow, fold)
        without = case.fit(*straight, None, fold)
        if with_creep is None or without is None:
            return False
        better = case.squares(*without, fold) - case.squares(*with_creep, fold)
        held_out = ~fold & np.isfinite(better)
        sums: Array = np.bincount(block[held_out], better[held_out], minlength=int(block.max()) + 1)
        gains.append(sums[np.unique(block[~fold])])
    # Ranks, because creep fades along the scan: a few blocks gain most, which says nothing against it.
    gain = np.concatenate(gains)
    return bool(gain.any() and wilcoxon(gain, alternative="greater").pvalue < _CHANCE)


class _Images:
    """A scan and the topography that it is compared with; warps between them fitted to any pixels."""

    def __init__(self, scan: Array, topography: Array, every: int = 1):
        """``every``: pixel of the topography is used; its index counts those that are."""
        from scipy.ndimage import spline_filter

        self._measured = np.isfinite(scan)
        self._spline = spline_filter(fill_gaps(scan), 3, output=np.float32, mode="mirror")
        steepness = np.gradient(topography.astype(float))
        self._gradient = [every * np.asarray(one)[::every, ::every] for one in reversed(steepness)]
        topography = topography[::every, ::every]
        shape = topography.shape
        self._surface = [topography - topography.mean(), *quadratic_basis(shape)]
        self.everywhere = interior_of(shape, BORDER_PX // every)

    def fit(self, matrix: Array, bend: Bend, slow: int | None, chosen: Array) -> tuple[Array, Bend] | None:
        """Affine and, with a slow axis, creep by Gauss-Newton steps; None if they do not settle."""
        y, x = (np.linspace(0, n - 1, 17) for n in self._measured.shape)
        points = lattice(y, x)
        for _ in range(_ITERATIONS):
            warped, (rows, columns), inside = self._warped(matrix, bend)
            inside &= chosen & self.everywhere
            flow = _flow(bend, columns[inside], rows[inside], slow)
            along = [gradient[inside] * one for gradient in self._gradient for one in flow]
            design = np.stack([*(one[inside] for one in self._surface), *along], axis=1)
            coefficients = _solve(design, warped[inside])
            if coefficients[0] <= 0:
                return None
            motion = coefficients[1 + _BACKGROUND :].reshape(2, -1) / coefficients[0]
            step_px = motion @ _flow(bend, points[:, 0], points[:, 1], slow)
            if not np.abs(step_px).max() < 0.2 * min(self._measured.shape):
                return None
            layout = apply_transform(np.linalg.inv(matrix), bend.straighten(points))
            degree = 2 if slow is None else CREEP_DEGREE
            try:
                moved = fit_bent_affine(points, layout + step_px.T, bend.middle, bend.half, degree)
            except np.linalg.LinAlgError:
                return None
            matrix, bend = np.linalg.inv(moved[0]), moved[1]
            if np.abs(step_px).max() < _SETTLED_PX:
                return matrix, bend
        return None

    def squares(self, matrix: Array, bend: Bend, fitted: Array) -> Array:
        """Squared misfit of every pixel, gain and background from the fitted ones; NaN outside the scan."""
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


def _flow(bend: Bend, x: Array, y: Array, slow: int | None) -> Array:
    """What can move a point of the scan along one axis: 1, u, v, and Legendre polynomials of the slow one."""
    unit = bend.unit(x, y)
    flows = [np.ones_like(unit[0]), *unit]
    if slow is not None:
        flows += list(np.polynomial.legendre.legvander(unit[slow], CREEP_DEGREE).T[2:])
    return np.stack(flows)


def _solve(design: Array, values: Array) -> Array:
    normal = design.T @ design
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    return np.linalg.solve(scaled, design.T @ values / scale) / scale
