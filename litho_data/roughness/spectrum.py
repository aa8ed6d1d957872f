"""Compute power spectral densities, normalised so that their integral over frequency is the variance."""

from dataclasses import dataclass
from typing import get_args

import numpy as np

from litho_data.foundation import Array, InputError, Shape, require_known
from litho_data.scan import Axis


@dataclass(frozen=True)
class Spectrum:
    """A one-sided power spectrum, i.e. one that is defined at positive frequencies only.

    Args:
        frequency_per_um: frequencies in cycles/µm, ascending.
        density: power spectral density in nm²·µm, whose integral over frequency is Sq².
    """

    frequency_per_um: Array
    density: Array


def psd_along(height_um: Array, pitch_um: float, axis: Axis, *, window: bool = True) -> Spectrum:
    """Return the one-sided power spectral density along one axis, averaged over the lines.

    The mean and slope of each line are removed. Each line is multiplied by a Hann window. The spectrum is
    corrected for the power of this window, so that ``Σ density·Δf`` is the mean square of the lines.

    Args:
        height_um: finite heights in µm, shape (ny, nx).
        pitch_um: pitch along the axis, in µm.
        axis: direction of the lines, ``x`` (along rows) or ``y`` (along columns).
        window: whether to remove the slope of each line and apply the window. False is suitable for surfaces
            that are periodic over the field or consist of noise.

    Raises:
        InputError: the surface contains NaN, the lines are shorter than 8 pixels, or the axis is neither x
            nor y.
    """
    from scipy.signal import periodogram

    lines = _lines(height_um, axis)
    size = lines.shape[1]
    shape, trend = (np.hanning(size + 2)[1:-1], "linear") if window else (np.ones(size), "constant")
    frequency, density = periodogram(lines, 1 / pitch_um, shape, detrend=trend)
    return Spectrum(frequency[1:], density.mean(axis=0)[1:])


def hann(shape: Shape) -> Array:
    """Return a two-dimensional Hann window of shape (ny, nx). The zeros that a Hann window has at its border
    are left out.
    """
    ny, nx = shape
    return np.outer(np.hanning(ny + 2)[1:-1], np.hanning(nx + 2)[1:-1])


def lines_nm(height_um: Array, axis: Axis) -> Array:
    """Return the profiles along an axis, in nm, as the rows of an array.

    Raises:
        InputError: the axis is neither x nor y.
    """
    require_known("axis", axis, get_args(Axis))
    return 1e3 * (height_um if axis == "x" else height_um.T).astype(float)


def _lines(height_um: Array, axis: Axis) -> Array:
    lines = lines_nm(height_um, axis)
    if not np.isfinite(lines).all():
        raise InputError(
            "surface", got="NaN", wanted="finite heights for a spectrum", hint="crop to valid pixels"
        )
    if lines.shape[1] < 8:
        raise InputError("length of lines for a spectrum", got=f"{lines.shape[1]} px", wanted="at least 8 px")
    return lines
