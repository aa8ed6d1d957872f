"""Estimate the error of a registration's warp, and the surface that the heights contain besides the print.

Gain, quadratic surface and warp are refitted with each block of the field left out in turn (jackknife). The
spread of these fits also includes effects that the topography does not explain, provided that these effects
differ between blocks.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from litho_data.foundation import Array, Shape
from litho_data.register.flows import BENT_COUNT, LADDER, flows, normalisation
from litho_data.register.pyramid import SCAN_BLUR_PX
from litho_data.register.refine import NUISANCES, aligned_gram, in_blocks, solve_gram
from litho_data.register.topography import predicted_topography, quadratic_basis, smooth_measured

# A surface is significant if the root mean square of its terms, each divided by its standard error, exceeds
# this value. On virtual prints without tilt and bow, the root mean square is at most 1.9.
_CLEAR = 6.0**0.5
# Distances, in layout pixels, over which the surrounding print affects the height (proximity, shrinkage). A
# fit that ignores this effect mistakes it for a surface. The surface is similar in neighbouring blocks, so
# the jackknife does not reveal the error.
_REACHES_PX = (4.0, 10.0, 25.0)
# Within a cell's width of the layout's border, a print has other surroundings than in the interior. Their
# effect is the same on all four sides and in all blocks there, and changes the magnification by more than
# the jackknife states. Without its outermost cells, a field of this many cells keeps two thirds of its area.
_FEWEST_CELLS = 12
_MAGNIFICATION = 3


@dataclass(frozen=True)
class WarpError:
    """The errors of the warp between a scan and its layout, and of the surface that the heights contain
    besides the print.

    Attributes:
        covariance: covariance (k, k) of the amounts of the flows in ``register.flows``, in the normalised
            layout frame.
        surface_rms: root mean square, over the field, of the quadratic surface that the fit finds in
            addition to the print. It excludes the offset and has the unit of the heights.
        surface_error_rms: root mean square of the error of that surface.
        is_clear: whether the surface is significant.
    """

    covariance: Array
    surface_rms: float
    surface_error_rms: float
    is_clear: bool

    def surface_variance(self, levelled: bool) -> float:
        """Return the mean square of the surface that the heights contain in addition to the print.

        The mean square of a fitted surface exceeds that of the true surface by the variance of the fit.
        Levelling also removes a quadratic surface that belongs to the print and its roughness. The error of
        the fit is an estimate of this missing surface. For levelled heights, the two mean squares are
        therefore added.
        """
        if levelled:
            return self.surface_rms**2 + self.surface_error_rms**2
        return max(self.surface_rms**2 - self.surface_error_rms**2, 0.0) if self.is_clear else 0.0

    def warp_variance(self, height: Array) -> Array:
        """Return the variance (ny, nx) that the error of the warp causes in the heights, mainly on slopes."""
        shape = height.shape
        normalise = normalisation(shape)
        gradient_y, gradient_x = (gradient / normalise[0, 0] for gradient in np.gradient(height))
        x = normalise[0, 0] * np.arange(shape[1])[None, :] + normalise[0, 2]
        y = normalise[1, 1] * np.arange(shape[0])[:, None] + normalise[1, 2]
        moved = np.stack(
            [
                (along_x * gradient_x + along_y * gradient_y).ravel()
                for along_x, along_y in flows(len(self.covariance), x, y)
            ]
        )
        sizes, directions = np.linalg.eigh(self.covariance)
        total: Array = np.maximum(sizes, 0.0) @ (directions.T @ moved) ** 2
        return total.reshape(shape)


def warp_error(height: Array, layout_level: Array, blur_px: float, model: str) -> WarpError:
    """Return the errors of a registration's warp, and of the surface that the heights contain besides the
    print.

    Args:
        height: (ny, nx) registered heights, NaN where not valid.
        layout_level: (ny, nx) integer levels.
        blur_px: sigma of the Gaussian blur of the topography, in layout pixels.
        model: the model in the quality record: a rung of the ladder, ``quadratic`` or ``creep``.
    """
    shape = height.shape
    smooth = np.where(np.isfinite(height), smooth_measured(height, SCAN_BLUR_PX), np.nan)
    count = {str(name): number for name, number in LADDER.items()}.get(model, BENT_COUNT)
    topography = predicted_topography(layout_level, blur_px)
    around = [_around(topography - topography.mean(), reach_px) for reach_px in _REACHES_PX]
    cells = aligned_gram(smooth, topography, count, around)
    blocks = in_blocks(cells).reshape(-1, *cells.shape[2:])
    # The registration ignores the surroundings, so its error is that of a fit without their terms.
    own = np.ix_(*[np.r_[: NUISANCES + count, -1]] * 2)
    _, covariance = _without_each(blocks[:, own[0], own[1]])
    if count > _MAGNIFICATION and min(cells.shape[:2]) >= _FEWEST_CELLS:
        at = NUISANCES + _MAGNIFICATION
        whole, inner = (solve_gram(one.sum(axis=(0, 1))[own]) for one in (cells, cells[1:-1, 1:-1]))
        covariance[at, at] += (inner[at] / inner[0] - whole[at] / whole[0]) ** 2
    fitted, spread = _without_each(blocks)
    terms = slice(2, NUISANCES)
    surface, error = fitted[terms], spread[terms, terms]
    products = _products(shape)
    return WarpError(
        covariance=covariance[NUISANCES:, NUISANCES:],
        surface_rms=float(surface @ products @ surface) ** 0.5,
        surface_error_rms=float((products * error).sum()) ** 0.5,
        is_clear=bool(np.mean(surface**2 / np.maximum(np.diag(error), 1e-300)) > _CLEAR**2),
    )


def _around(topography: Array, reach_px: float) -> Array:
    """Return the Gaussian mean of the topography around each pixel, with reflection at the border."""
    import cv2

    width_px = 2 * round(3 * reach_px) + 1
    return cv2.GaussianBlur(topography, (width_px, width_px), reach_px, borderType=cv2.BORDER_REFLECT)


@lru_cache(maxsize=4)
def _products(shape: Shape) -> Array:
    """Return the covariance matrix (5, 5), over the field, of the terms of a quadratic surface."""
    return np.cov(quadratic_basis(shape)[1:].reshape(5, -1), bias=True)


def _without_each(blocks: Array) -> tuple[Array, Array]:
    """Return the mean and jackknife covariance of the coefficients, from inner products (blocks, k, k)."""
    without = solve_gram(blocks.sum(axis=0) - blocks)
    without[:, NUISANCES:] /= without[:, :1]
    middle = without.mean(axis=0)
    spread: Array = (len(blocks) - 1) / len(blocks) * (without - middle).T @ (without - middle)
    return middle, spread
