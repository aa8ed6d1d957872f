"""Slopes, developed area and texture of a surface (ISO 25178-2), and the filters that come before them."""

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import YX, Array
from litho_data.foundation.results import Record
from litho_data.roughness.amplitude import autocorrelation, first_fall

# ISO 16610-61: half of the amplitude passes at the cut-off.
_ALPHA = float(np.sqrt(np.log(2) / np.pi))
# ISO 25178-2, first derivative from three neighbours on each side, for 60 pitches.
_SLOPE = (-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0)
_REACH = len(_SLOPE) // 2
_DECAYED = 0.2
_DIRECTIONS = 180


class ArealParameters(Record):
    """Slopes and texture; they depend on the pitch and on both cut-offs, so state all three with them.

    Args:
        sdq: root mean square of the slope |∇z|.
        sdr: developed area over the projected one, minus 1.
        sal_um: shortest distance over which the autocorrelation falls to 0.2; infinite if it never does.
        str_ratio: Str, that distance over the longest, from 0 (one direction) to 1 (the same in all); 0 if
            some direction does not fall to 0.2 within half the field.
        pixels: pixels counted for the slopes.
    """

    sdq: float
    sdr: float
    sal_um: float
    str_ratio: float
    pixels: int


def areal_parameters(height_um: Array, pitch_um: YX) -> ArealParameters:
    """Sdq, Sdr, Sal and Str of a levelled and filtered surface.

    Sdq² = mean |∇z|², Sdr = mean √(1 + |∇z|²) − 1 with the slopes of seven pixels, so that three pixels at
    each border are not counted.

    Args:
        height_um: (ny, nx), µm, without NaN.
        pitch_um: (y, x).

    Raises:
        InputError: NaN, a flat surface, fewer than 7 × 7 pixels, or pitches that are not positive.
    """
    height = _checked(height_um, pitch_um)
    if min(height.shape) < len(_SLOPE):
        raise InputError("surface", got=f"{height.shape} pixels", wanted="at least 7 x 7")
    inner = slice(_REACH, -_REACH)
    slope_y = _slope(height, 0)[inner, inner] / pitch_um[0]
    slope_x = _slope(height, 1)[inner, inner] / pitch_um[1]
    squared = slope_x**2 + slope_y**2
    shortest, longest = decay_lengths_um(autocorrelation(height), pitch_um)
    return ArealParameters(
        sdq=float(np.sqrt(squared.mean())),
        # √(1 + s) − 1 without the cancellation.
        sdr=float((squared / (np.sqrt(1 + squared) + 1)).mean()),
        sal_um=shortest,
        str_ratio=shortest / longest if np.isfinite(longest) else 0.0,
        pixels=int(squared.size),
    )


def low_pass(height_um: Array, pitch_um: YX, cut_off_um: float) -> Array:
    """The S-filter: what is longer than the cut-off, by the Gaussian of ISO 16610-61.

    An amplitude passes by exp(−π (α·cut_off/λ)²), α² = ln 2 / π: by half at the cut-off. At a border and
    around gaps the weights that are left are scaled to one.

    Args:
        height_um: (ny, nx), µm, NaN where not measured.
        pitch_um: (y, x).
        cut_off_um: wavelength.

    Raises:
        InputError: a pitch or cut-off that is not positive.
    """
    from scipy.ndimage import gaussian_filter

    height = np.asarray(height_um, dtype=float)
    if not (cut_off_um > 0 and min(pitch_um) > 0):
        raise InputError("cut-off and pitch in µm", got=(cut_off_um, pitch_um), wanted="positive numbers")
    sigma_px = [_ALPHA * cut_off_um / (np.sqrt(2 * np.pi) * pitch) for pitch in pitch_um]
    measured = np.isfinite(height)
    options = {"mode": "constant", "truncate": 6.0}
    weight = gaussian_filter(measured.astype(float), sigma_px, **options)
    total = gaussian_filter(np.where(measured, height, 0.0), sigma_px, **options)
    return np.where(measured, total / np.maximum(weight, 1e-300), np.nan)


def high_pass(height_um: Array, pitch_um: YX, cut_off_um: float) -> Array:
    """The L-filter: what is shorter than the cut-off, the surface minus its ``low_pass``."""
    return np.asarray(height_um, dtype=float) - low_pass(height_um, pitch_um, cut_off_um)


def decay_lengths_um(correlation: Array, pitch_um: YX) -> tuple[float, float]:
    """Shortest and longest distance over all directions at which a correlation first falls to 0.2, µm.

    Args:
        correlation: as ``autocorrelation`` gives it: lags of 0 … ny − 1 rows and −n … n columns.
        pitch_um: (y, x) of a lag.

    Infinite for a direction that does not fall to 0.2 within the lags that are given.
    """
    from scipy.ndimage import map_coordinates

    rows, middle = correlation.shape[0] - 1, correlation.shape[1] // 2
    largest_um = np.hypot(rows * pitch_um[0], middle * pitch_um[1])
    step_um = min(pitch_um) / 4
    distance_um = np.arange(0.0, largest_um, step_um)
    lengths = []
    for angle in np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
        places = np.array(
            [np.sin(angle) * distance_um / pitch_um[0], middle + np.cos(angle) * distance_um / pitch_um[1]]
        )
        within = (places[0] <= rows) & (places[1] >= 0) & (places[1] <= 2 * middle)
        values = map_coordinates(correlation, places[:, within], order=3, mode="mirror")
        lengths.append(step_um * first_fall(values, _DECAYED))
    return min(lengths), max(lengths)


def _slope(height: Array, axis: int) -> Array:
    """Change of height per pixel, (ny, nx); three pixels at each end of the axis are not to be used."""
    from scipy.ndimage import correlate1d

    return correlate1d(height, np.array(_SLOPE) / 60, axis=axis)


def _checked(height_um: Array, pitch_um: YX) -> Array:
    height = np.asarray(height_um, dtype=float)
    if height.ndim != 2 or not np.isfinite(height).all():
        raise InputError("surface", got="gaps or no map", wanted="finite heights (ny, nx)")
    if not min(pitch_um) > 0:
        raise InputError("pitch in µm", got=pitch_um, wanted="positive numbers")
    return height
