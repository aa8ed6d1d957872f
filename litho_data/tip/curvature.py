"""Estimate the noise of a scan, the curvatures of its surface over small discs, and the noise of these
curvatures.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from litho_data.foundation import YX, Array
from litho_data.roughness.noise import fine_differences, robust_sd

# Radii, in pixels, of the discs over which curvatures are fitted. Each disc contains more pixels than the one
# before.
DISC_RADII_PX = (2.0, 2.25, 2.5, 2.85, 3.2, 3.65, 4.0, 4.5, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0, 15.0, 20.0)
# Largest accepted standard deviation of a measured curvature, as a share of the curvature of the tip.
QUIET = 0.17


@dataclass(frozen=True)
class Noise:
    """The noise of a scan: standard deviations, in µm, of the white noise of single pixels and of the offsets
    of whole rows or columns.
    """

    pixel_um: float
    line_um: float
    lines_are_rows: bool


def noise_of(height_um: Array) -> Noise:
    """Estimate the noise of a scan from fourth differences of its heights. ``height_um`` has shape (ny, nx).

    The fourth differences of a parabola are zero, so the parabolas that a tip leaves in the image do not
    affect the estimate. If the differences along the columns are larger than the differences along the rows,
    the excess is attributed to offsets of whole rows, and vice versa.
    """
    rows, columns = (np.nan_to_num(robust_sd(fine_differences(height_um, 4, axis))) for axis in (0, 1))
    pixel, other = min(rows, columns), max(rows, columns)
    return Noise(pixel, float(np.sqrt(other**2 - pixel**2)), rows > columns)


def highest_curvature(height_um: Array, pitch_um: YX, radius_px: float) -> Array:
    """Fit a quadratic surface to a disc around each pixel, and return the highest principal curvature of each
    fit in 1/µm. The result has shape (ny, nx).

    The fits are exact for a quadratic surface, and the fitted second derivatives have the least noise of all
    linear estimates from the heights on the disc. The result is NaN where the disc extends beyond the scan or
    contains an unmeasured pixel.

    Args:
        height_um: heights in µm, shape (ny, nx); NaN where not measured.
        pitch_um: pixel pitch along y and x, µm.
        radius_px: radius of the disc, pixels.
    """
    from scipy.ndimage import binary_dilation
    from scipy.signal import oaconvolve

    kernels, edge = disc_kernels(radius_px, pitch_um), int(radius_px)
    measured = np.isfinite(height_um)
    highest = np.full(height_um.shape, np.nan)
    if min(height_um.shape) < kernels.shape[-1]:
        return highest
    filled = np.where(measured, height_um, 0.0)
    xx, xy, yy = (oaconvolve(filled, kernel[::-1, ::-1], mode="valid") for kernel in kernels)
    inner = slice(edge, height_um.shape[0] - edge), slice(edge, height_um.shape[1] - edge)
    highest[inner] = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
    if not measured.all():
        highest[binary_dilation(~measured, structure=disc(radius_px))] = np.nan
    return highest


def curvature_noise(noise: Noise, pitch_um: YX, radius_px: float) -> float:
    """Return the standard deviation, in 1/µm, of the curvatures that ``highest_curvature`` would measure on a
    flat surface whose heights contain the given noise.

    The standard deviation is computed for the curvatures along x and along y, and the larger one is returned.
    """
    largest = 0.0
    for kernel in disc_kernels(radius_px, pitch_um)[[0, 2]]:
        lines = kernel.sum(axis=1 if noise.lines_are_rows else 0)
        variance = noise.pixel_um**2 * (kernel**2).sum() + noise.line_um**2 * (lines**2).sum()
        largest = max(largest, float(np.sqrt(variance)))
    return largest


@lru_cache(maxsize=64)
def disc_kernels(radius_px: float, pitch_um: YX) -> Array:
    """Return three sets of weights for the heights on a disc. The weighted sums of the heights are the second
    derivatives of the quadratic surface that fits the heights best. The result has shape (3, n, n) and the
    unit 1/µm².

    The order of the derivatives is xx, xy, yy.
    """
    inside = disc(radius_px)
    y_px, x_px = (places - int(radius_px) for places in np.nonzero(inside))
    y, x = y_px * pitch_um[0], x_px * pitch_um[1]
    design = np.stack([np.ones(x.size), x, y, x**2 / 2, x * y, y**2 / 2], axis=1)
    kernels = np.zeros((3, *inside.shape))
    kernels[:, inside] = np.linalg.pinv(design)[3:]
    kernels.setflags(write=False)
    return kernels


def disc(radius_px: float) -> Array:
    """Return a bool array that is True at the pixels inside a disc around the middle pixel. Its shape is (n,
    n) with an odd n.
    """
    half = int(radius_px)
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    return x**2 + y**2 <= radius_px**2 + 1e-9
