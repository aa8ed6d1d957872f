"""How far a registered scan may lie off its layout, pixel by pixel, and its surface beside the print.

Gain, quadratic surface and warp are fitted again without each block of the field in turn (jackknife). The
spread of the fits contains what the topography does not explain, as far as blocks differ in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from litho_data.register.flows import BENT_COUNT, LADDER, flows, normalisation
from litho_data.register.pyramid import SCAN_BLUR_PX
from litho_data.register.refine import NUISANCES, aligned_gram, in_blocks, solve_gram
from litho_data.register.topography import predicted_topography, quadratic_basis, smooth_measured

# A surface is real if its terms exceed their standard errors by this factor, in root mean square. On virtual
# prints without tilt and bow it is 1.9 at most.
_CLEAR = 6.0**0.5
# How far a place feels what is printed around it (proximity, shrinkage), layout pixels. A fit without that
# takes it for a surface, and the same in neighbouring blocks, so that the jackknife does not see it.
_REACHES_PX = (4.0, 10.0, 25.0)


@dataclass(frozen=True)
class WarpError:
    """Errors of the fit that put a scan on its layout.

    Attributes:
        covariance: (k, k) of the amounts of the flows of ``register.flows``, normalised layout frame.
        surface_rms: of the quadratic surface that the scan has beside the print, its offset aside, over the
            field, unit of the heights. The true one lies about the fitted one as far as the fit errs, so its
            expected square is that of the fitted one and the variance of the fit.
        is_clear: whether there is such a surface.
    """

    covariance: np.ndarray
    surface_rms: float
    is_clear: bool

    def warp_variance(self, height: np.ndarray) -> np.ndarray:
        """Variance of registered heights (ny, nx) by the error of the warp: steep places move most."""
        shape = (height.shape[0], height.shape[1])
        normalise = normalisation(shape)
        gradient_y, gradient_x = (gradient / normalise[0, 0] for gradient in np.gradient(height))
        x = normalise[0, 0] * np.arange(shape[1])[None, :] + normalise[0, 2]
        y = normalise[1, 1] * np.arange(shape[0])[:, None] + normalise[1, 2]
        moved = [
            along_x * gradient_x + along_y * gradient_y
            for along_x, along_y in flows(len(self.covariance), x, y)
        ]
        sizes, directions = np.linalg.eigh(self.covariance)
        total = np.zeros(shape)
        for size, direction in zip(sizes, directions.T, strict=True):
            combined = sum(part * one for part, one in zip(direction, moved, strict=True))
            total += max(size, 0.0) * combined**2
        return total


def warp_error(height: np.ndarray, layout_level: np.ndarray, blur_px: float, model: str) -> WarpError:
    """The errors of a registration, and the surface beside the print.

    Args:
        height: (ny, nx) registered heights, NaN where not valid.
        layout_level: (ny, nx) integer levels.
        blur_px: Gaussian sigma of the topography, layout pixels.
        model: as in the quality record: a rung of the ladder, ``quadratic`` or ``creep``.
    """
    from scipy.ndimage import gaussian_filter

    shape = (height.shape[0], height.shape[1])
    smooth = np.where(np.isfinite(height), smooth_measured(height, SCAN_BLUR_PX), np.nan)
    count = {str(name): number for name, number in LADDER.items()}.get(model, BENT_COUNT)
    topography = predicted_topography(layout_level, blur_px)
    around = [gaussian_filter(topography - topography.mean(), reach, truncate=3.0) for reach in _REACHES_PX]
    blocks = in_blocks(aligned_gram(smooth, topography, count, around))
    blocks = blocks.reshape(-1, *blocks.shape[2:])
    # The registration knows nothing of the surroundings, so its error is that of a fit without them.
    own = np.r_[: NUISANCES + count, -1]
    _, covariance = _without_each(blocks[:, own[:, None], own])
    fitted, spread = _without_each(blocks)
    terms = slice(2, NUISANCES)
    surface, error = fitted[terms], spread[terms, terms]
    is_clear = bool(np.mean(surface**2 / np.maximum(np.diag(error), 1e-300)) > _CLEAR**2)
    products = np.cov(quadratic_basis(shape)[1:].reshape(len(surface), -1), bias=True)
    squared = surface @ products @ surface + (products * error).sum()
    return WarpError(covariance[NUISANCES:, NUISANCES:], float(squared) ** 0.5, is_clear)


def _without_each(blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and jackknife covariance of the coefficients, from inner products (blocks, k, k)."""
    without = solve_gram(blocks.sum(axis=0) - blocks)
    without[:, NUISANCES:] /= without[:, :1]
    middle = without.mean(axis=0)
    spread: np.ndarray = (len(blocks) - 1) / len(blocks) * (without - middle).T @ (without - middle)
    return middle, spread
