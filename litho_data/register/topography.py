"""Prepare layout and scan for their comparison. A topography is predicted from the layout. The heights of the
scan are smoothed, their gaps are filled, and their bow is removed.
"""

from functools import lru_cache

import numpy as np

from litho_data.foundation import Array, Shape


def predicted_topography(layout_level: Array, blur_px: float) -> Array:
    """Predict the printed topography to first order, by blurring the layout's levels with a Gaussian.

    Args:
        layout_level: integer levels, shape (ny, nx).
        blur_px: sigma, in layout pixels, of the Gaussian that stands for the printing process.

    Returns:
        The topography as float32 of shape (ny, nx), in units of levels. The gain and the offset that convert
        it to heights are unknown.
    """
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(layout_level.astype(np.float32), blur_px, mode="nearest", truncate=3.0)


def smooth_measured(height: Array, sigma_px: float) -> Array:
    """Smooth heights with a Gaussian by normalised convolution, which averages over the measured pixels only.

    Args:
        height: heights, shape (ny, nx), NaN where not measured.
        sigma_px: sigma of the Gaussian, in pixels.

    Returns:
        The smoothed heights as float64 of shape (ny, nx). A pixel in a gap has the weighted mean height of
        the measured pixels around it. A pixel is NaN only if no measured pixel lies within 4 sigma.
    """
    from scipy.ndimage import gaussian_filter

    measured = np.isfinite(height)
    if measured.all():
        return gaussian_filter(height.astype(float), sigma_px)
    weight = gaussian_filter(measured.astype(float), sigma_px)
    total = gaussian_filter(np.where(measured, height, 0.0).astype(float), sigma_px)
    # If the weight exceeds 1e-9, at least a few distant measured pixels contribute to the mean. A smaller
    # weight is only rounding error.
    return np.divide(total, weight, out=np.full(height.shape, np.nan), where=weight > 1e-9)


def fill_gaps(height: Array) -> Array:
    """Replace every NaN in the heights by a value extrapolated from the measured heights.

    In the first three pixels of a gap, the measured heights are continued by point reflection about the
    nearest measured pixel. Slopes therefore continue into the gap, and an interpolating spline does not ring
    at the border of the gap. Farther inside the gap, a pixel has the height of the nearest measured pixel.
    """
    from scipy.ndimage import distance_transform_edt

    missing = ~np.isfinite(height)
    if not missing.any():
        return height
    distance, (rows, columns) = distance_transform_edt(missing, return_indices=True)
    held = height[rows, columns]
    y, x = np.nonzero(missing & (distance <= 3))
    mirror_y = np.clip(2 * rows[y, x] - y, 0, height.shape[0] - 1)
    mirror_x = np.clip(2 * columns[y, x] - x, 0, height.shape[1] - 1)
    continued = 2 * held[y, x] - height[mirror_y, mirror_x]
    held[y, x] = np.where(np.isfinite(continued), continued, held[y, x])
    return held


def remove_bow(height: Array) -> Array:
    """Return the heights minus the quadratic surface that fits them best (least squares).

    The bow is removed only from copies of the heights that are compared with the layout.
    """
    basis = quadratic_basis(height.shape)
    measured = np.isfinite(height)
    # Every third row and column determines the six coefficients as well as all rows and columns do.
    sparse = np.zeros_like(measured)
    sparse[::3, ::3] = measured[::3, ::3]
    chosen = sparse if sparse.sum() >= 60 else measured
    coefficients, *_ = np.linalg.lstsq(basis[:, chosen].T, height[chosen], rcond=None)
    return height - np.einsum("k,kyx->yx", coefficients, basis)


@lru_cache(maxsize=4)
def quadratic_basis(shape: Shape) -> Array:
    """Return the terms 1, x, y, x², xy and y² of a quadratic surface at every pixel of an image.

    The coordinates x and y run from -1 to 1. The result is a read-only array of shape (6, ny, nx).
    """
    y = np.linspace(-1, 1, shape[0])[:, None]
    x = np.linspace(-1, 1, shape[1])[None, :]
    one = np.ones(shape)
    basis = np.stack([one, one * x, one * y, one * x * x, x * y, one * y * y])
    basis.setflags(write=False)
    return basis


def pearson(a: Array, b: Array) -> float:
    """Return the Pearson correlation of two vectors of equal length, or 0 if one of them is constant.

    Sums are used in place of a matrix product, whose result could depend on the number of BLAS threads.
    """
    a, b = (values - values.mean(dtype=float) for values in (a, b))
    energy = float((a * a).sum()) * float((b * b).sum())
    return float((a * b).sum()) / energy**0.5 if energy > 0 else 0.0
