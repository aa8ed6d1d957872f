"""For a registered scan, estimate two things: the quadratic surface that the heights contain in addition to
the print, and the error of the warp.

Gain, quadratic surface and warp are fitted many times. Each time, another block of the field is left out
(jackknife). Some structure in the heights does not follow from the layout and causes errors of the fits. If
this structure differs from block to block, the spread of the fits includes these errors.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from litho_data.foundation import Array, Shape
from litho_data.register.flows import BENT_COUNT, LADDER, changes, normalisation
from litho_data.register.pyramid import SCAN_BLUR_PX
from litho_data.register.refine import NUISANCES, aligned_gram, in_blocks, solve_gram
from litho_data.register.topography import predicted_topography, quadratic_basis, smooth_measured

# A surface is significant if the root mean square of its coefficients, each divided by its standard error,
# exceeds this value. On virtual prints without tilt and bow, the root mean square is at most 1.9.
_CLEAR = 6.0**0.5
# Distances, in layout pixels, over which the surroundings of a point affect its height (proximity,
# shrinkage). A fit that ignores this effect mistakes part of the effect for a quadratic surface. This part is
# similar in adjacent blocks, so the jackknife would not show the error.
_REACHES_PX = (4.0, 10.0, 25.0)
# Near the layout's border, a print has other surroundings than in the interior. Their effect is the same in
# all blocks at the border, so it may change the fitted magnification by more than the jackknife estimates.
# The change is found by a second fit, without the outermost cells. Such a fit is made only if there are at
# least this many cells along each side, so that two thirds of the area remain.
_FEWEST_CELLS = 12
_MAGNIFICATION = 3


@dataclass(frozen=True)
class WarpError:
    """The error of the warp between a scan and its layout, and the quadratic surface that the heights contain
    in addition to the print. The error of this surface is included.

    Attributes:
        covariance: covariance matrix, of shape (k, k), of the coefficients of the warp's generators (see
            ``register.flows``), in the normalised frame of the layout.
        surface_rms: root mean square, over the field, of the quadratic surface without its offset, in the
            unit of the heights.
        surface_error_rms: root mean square, over the field, of the error of this surface.
        is_clear: whether the surface is significant.
    """

    covariance: Array
    surface_rms: float
    surface_error_rms: float
    is_clear: bool

    def surface_variance(self, levelled: bool) -> float:
        """Return an estimate of the mean square of the surface by which the heights differ from the print.

        Args:
            levelled: whether the heights were levelled.

        On average, the mean square of a fitted surface exceeds the mean square of the true surface by the
        variance of the fit. For heights that were not levelled, this variance is therefore subtracted, and
        the result is 0 if the surface is not significant. Levelling also removes the quadratic part of the
        print and of its roughness. The mean square of this part is estimated by the variance of the fit. For
        levelled heights, the result is therefore the sum of the mean squares of the fitted surface and of its
        error.
        """
        if levelled:
            return self.surface_rms**2 + self.surface_error_rms**2
        return max(self.surface_rms**2 - self.surface_error_rms**2, 0.0) if self.is_clear else 0.0

    def warp_variance(self, height: Array) -> Array:
        """Return the variance that the error of the warp causes in the heights, mainly on slopes.

        ``height`` and the result have shape (ny, nx).
        """
        moved = changes(height.astype(float), len(self.covariance)) / normalisation(height.shape)[0, 0]
        sizes, directions = np.linalg.eigh(self.covariance)
        total: Array = np.maximum(sizes, 0.0) @ (directions.T @ moved.reshape(len(moved), -1)) ** 2
        return total.reshape(height.shape)


def warp_error(height: Array, layout_level: Array, blur_px: float, model: str) -> WarpError:
    """For registered heights, estimate two things: the quadratic surface that they contain in addition to the
    print, and the error of the registration's warp.

    Args:
        height: registered heights, shape (ny, nx), NaN where not valid.
        layout_level: integer levels, shape (ny, nx).
        blur_px: sigma, in layout pixels, of the Gaussian blur with which the topography is predicted.
        model: the kind of warp, as stated in the quality record: a key of ``LADDER``, ``quadratic`` or
            ``creep``.
    """
    shape = height.shape
    smooth = np.where(np.isfinite(height), smooth_measured(height, SCAN_BLUR_PX), np.nan)
    count = {str(name): number for name, number in LADDER.items()}.get(model, BENT_COUNT)
    topography = predicted_topography(layout_level, blur_px)
    around = [_around(topography - topography.mean(), reach_px) for reach_px in _REACHES_PX]
    cells = aligned_gram(smooth, topography, count, around)
    blocks = in_blocks(cells).reshape(-1, *cells.shape[2:])
    # The registration does not fit the effect of the surroundings. The error of its warp is therefore
    # computed from a fit without the regressors in ``around``.
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
    """Return the mean of the topography around each pixel, weighted by a Gaussian of sigma ``reach_px``.
    Beyond the border, the topography is extended by reflection.
    """
    import cv2

    width_px = 2 * round(3 * reach_px) + 1
    return cv2.GaussianBlur(topography, (width_px, width_px), reach_px, borderType=cv2.BORDER_REFLECT)


@lru_cache(maxsize=4)
def _products(shape: Shape) -> Array:
    """Return the covariance matrix, over the field, of the terms x, y, x², xy and y² of a quadratic surface.
    The result has shape (5, 5).
    """
    return np.cov(quadratic_basis(shape)[1:].reshape(5, -1), bias=True)


def _without_each(blocks: Array) -> tuple[Array, Array]:
    """Return the mean and the jackknife (leave-one-block-out) covariance of the fitted coefficients, computed
    from per-block inner products of shape (blocks, k, k).

    Of the fitted coefficients, those of the warp are first divided by that of the gain.
    """
    without = solve_gram(blocks.sum(axis=0) - blocks)
    without[:, NUISANCES:] /= without[:, :1]
    middle = without.mean(axis=0)
    spread: Array = (len(blocks) - 1) / len(blocks) * (without - middle).T @ (without - middle)
    return middle, spread
