"""Estimate the noise of single pixels and the noise of whole scan lines, leaving out the structure of the
print.
"""

from math import comb

import numpy as np

from litho_data.foundation import Array
from litho_data.roughness.spectrum import lines_nm
from litho_data.scan import Axis

# The median absolute deviation of a Gaussian is 0.6745 sd.
_MAD_TO_SD = 1 / 0.6744897501960817
# Order of the differences. Relative to a wave at the Nyquist frequency, a wave at 0.74 of this frequency is
# weakened to a half, and a wave at 0.42 of it (0.21 cycles per pixel) to a fiftieth.
_FINE_ORDER = 8


def white_noise(height_um: Array, *, fast_axis: Axis = "x") -> tuple[float, float]:
    """Estimate the white pixel noise and the line noise of a scan, in nm, without knowing what was printed.

    A printer writes nothing finer than its spot, so differences of high order between neighbouring pixels
    contain only noise. Differences along both axes give the pixel noise. Differences of the line means along
    the slow axis give the line noise. The estimates do not include drift (noise that is correlated between
    lines) or noise that the microscope's feedback has smoothed, because both look like printed structures.

    Args:
        height_um: heights in µm, shape (ny, nx); NaN where not measured.
        fast_axis: axis along which the tip moved fast.

    Returns:
        Standard deviations of the pixel noise and of the line noise; NaN if there are too few pixels to
        determine them.
    """
    lines = lines_nm(height_um, fast_axis)
    pixel_nm = _fine_sd(_fine(_fine(lines, 0), 1))
    measured = np.isfinite(lines)
    count = measured.sum(axis=1)
    means = np.where(measured, lines, 0.0).sum(axis=1) / np.maximum(count, 1)
    line_nm = _fine_sd(_fine(np.where(2 * count > lines.shape[1], means, np.nan), 0))
    own_nm2 = line_nm**2 - pixel_nm**2 / max(1.0, float(np.median(count)))
    return pixel_nm, float(np.sqrt(np.maximum(own_nm2, 0.0)))


def _fine(values: Array, axis: int) -> Array:
    return fine_differences(values, _FINE_ORDER, axis)


def fine_differences(values: Array, order: int, axis: int) -> Array:
    """Return the differences of the given order along an axis. They are scaled so that the differences of
    white noise have the variance of the noise itself. The differences of a polynomial whose degree is below
    ``order`` are zero.
    """
    return np.diff(values, order, axis=axis) / comb(2 * order, order) ** 0.5


def _fine_sd(differences: Array) -> float:
    return robust_sd(differences) if np.isfinite(differences).sum() > _FINE_ORDER else float("nan")


def robust_sd(values: Array) -> float:
    """Estimate a standard deviation from the median absolute deviation. NaN is ignored; if there are no other
    values, the result is NaN.
    """
    known = values[np.isfinite(values)]
    return float(_MAD_TO_SD * np.median(np.abs(known - np.median(known)))) if known.size else float("nan")
