"""Prepare layout and scan for comparison: predict a topography, smooth heights, fill gaps and remove bow."""

from functools import lru_cache

import numpy as np

from litho_data.foundation import Array, Shape


def predicted_topography(layout_level: Array, blur_px: float) -> Array:
    """Predict the printed topography to first order, by blurring the layout's levels with a Gaussian.

    Args:
        layout_level: (ny, nx) integer levels.
        blur_px: sigma of the Gaussian that stands for the process, in layout pixels.

    Returns:
        (ny, nx) float32 in levels; the gain and offset that turn levels into heights remain free.
    """
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(layout_level.astype(np.float32), blur_px, mode="nearest", truncate=3.0)


def smooth_measured(height: Array, sigma_px: float) -> Array:
    """Smooth heights with a Gaussian by normalised convolution, so that gaps neither bias the mean nor grow.

    Args:
        height: (ny, nx), NaN where not measured.
        sigma_px: sigma of the Gaussian, in pixels.

    Returns:
        (ny, nx) float64; gaps are filled from their surroundings. Pixels are NaN only where no measured
        pixel lies within 4 sigma.
    """
    from scipy.ndimage import gaussian_filter

    measured = np.isfinite(height)
    if measured.all():
        return gaussian_filter(height.astype(float), sigma_px)
    weight = gaussian_filter(measured.astype(float), sigma_px)
    total = gaussian_filter(np.where(measured, height, 0.0).astype(float), sigma_px)
    # If the weight exceeds 1e-9, at least a few distant measured pixels lie within reach. A smaller weight is
    # only rounding error.
    return np.divide(total, weight, out=np.full(height.shape, np.nan), where=weight > 1e-9)


def fill_gaps(height: Array) -> Array:
    """Replace every NaN in the heights by extrapolating for three pixels and then holding a constant.

    In the first three pixels of a gap, the heights are the measured heights after point reflection about the
    nearest measured pixel. Slopes therefore continue, and an interpolating spline does not ring at the
    border.
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
    """Subtract the least-squares quadratic surface from heights; used only on copies for comparison."""
    basis = quadratic_basis(height.shape)
    measured = np.isfinite(height)
    # A third of the rows and columns determines six coefficients as well as all of them do.
    sparse = np.zeros_like(measured)
    sparse[::3, ::3] = measured[::3, ::3]
    chosen = sparse if sparse.sum() >= 60 else measured
    coefficients, *_ = np.linalg.lstsq(basis[:, chosen].T, height[chosen], rcond=None)
    return height - np.einsum("k,kyx->yx", coefficients, basis)


@lru_cache(maxsize=4)
def quadratic_basis(shape: Shape) -> Array:
    """Return the terms 1, x, y, x², xy and y² on every pixel, as a read-only array (6, ny, nx). The
    coordinates x and y run from -1 to 1.
    """
    y = np.linspace(-1, 1, shape[0])[:, None]
    x = np.linspace(-1, 1, shape[1])[None, :]
    one = np.ones(shape)
    basis = np.stack([one, one * x, one * y, one * x * x, x * y, one * y * y])
    basis.setflags(write=False)
    return basis


def pearson(a: Array, b: Array) -> float:
    """Return the Pearson correlation of two equally long vectors, or 0 if one of them is constant.

    Sums are used instead of a matrix product, so that the result does not depend on the number of BLAS
    threads.
    """
    a, b = (values - values.mean(dtype=float) for values in (a, b))
    energy = float((a * a).sum()) * float((b * b).sum())
    return float((a * b).sum()) / energy**0.5 if energy > 0 else 0.0
