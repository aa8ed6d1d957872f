"""Power spectral densities whose integral is the variance."""

from dataclasses import dataclass
from typing import get_args

import numpy as np

from litho_data.foundation import Array, InputError, Shape, require_known
from litho_data.scan import Axis


@dataclass(frozen=True)
class Spectrum:
    """A spectrum on positive frequencies.

    Args:
        frequency_per_um: cycles/µm, ascending.
        density: nm²·µm; its integral over frequency is Sq², one-sided.
    """

    frequency_per_um: Array
    density: Array


def psd_along(height_um: Array, pitch_um: float, axis: Axis, *, window: bool = True) -> Spectrum:
    """One-sided power spectral density along one axis, averaged over the lines.

    Mean and slope of each line are removed, and the line is weighted by a Hann window, whose power is divided
    out. The spectrum is scaled so that ``Σ density·Δf`` is the mean square of the lines.

    Args:
        height_um: finite heights, µm, shape (ny, nx).
        pitch_um: pitch along the axis, µm.
        axis: ``x`` along rows, ``y`` along columns.
        window: False leaves the lines unweighted, for periodic or noise-like surfaces.

    Raises:
        InputError: NaN in the surface, lines shorter than 8 pixels, or another axis.
    """
    from scipy.signal import periodogram

    lines = _lines(height_um, axis)
    size = lines.shape[1]
    shape, trend = (np.hanning(size + 2)[1:-1], "linear") if window else (np.ones(size), "constant")
    frequency, density = periodogram(lines, 1 / pitch_um, shape, detrend=trend)
    return Spectrum(frequency[1:], density.mean(axis=0)[1:])


def hann(shape: Shape) -> Array:
    """Hann window of a field (ny, nx), nowhere zero."""
    ny, nx = shape
    return np.outer(np.hanning(ny + 2)[1:-1], np.hanning(nx + 2)[1:-1])


def lines_nm(height_um: Array, axis: Axis) -> Array:
    """Profiles along an axis as rows, nm.

    Raises:
        InputError: another axis.
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
        raise InputError("lines of a spectrum", got=f"{lines.shape[1]} px", wanted="at least 8 px")
    return lines
