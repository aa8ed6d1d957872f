"""Align the rows of a scan, i.e. remove the height offsets between them, by the methods of Gwyddion's
function Align Rows.
"""

import warnings
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from litho_data.foundation import YX, Array, InputError
from litho_data.level.operation import operation
from litho_data.level.plane import prevailing_slope
from litho_data.level.row_statistics import METRE_PER_UM, row_modus, row_trimmed_mean
from litho_data.level.selection import Levelled, Masking, subtract

RowMethod = Literal[
    "median",
    "median-of-differences",
    "trimmed-mean",
    "trimmed-mean-of-differences",
    "polynomial",
    "matching",
    "modus",
    "facet-tilt",
]
Direction = Literal["horizontal", "vertical"]
_MEDIAN_TRIM, _FEWEST_SLOPES = 0.5, 4
_SIGMA_PER_MAD, _CLEAR_SIGMA, _STAYED = 1.4826, 6.0, 0.15


class LevellingWarning(UserWarning):
    """Warning that a levelling step may have removed part of the print."""


@operation("align-rows")
def align_rows(
    z: Array,
    chosen: Array,
    *,
    method: RowMethod = "median",
    direction: Direction = "horizontal",
    degree: Annotated[int, Field(ge=0, le=5)] = 1,
    trim: Annotated[float, Field(ge=0, le=_MEDIAN_TRIM)] = 0.05,
    pitch_um: YX | None = None,
    masking: Masking = "exclude",
) -> Levelled:
    """Align the rows of a scan. Warn if some of the shifts between rows seem to be part of the print instead
    of an error of the scan.

    Args:
        z: heights in µm, shape (ny, nx). The results of the methods ``"matching"`` and ``"modus"`` depend on
            the unit. These methods therefore convert the heights from µm to metres, the unit that Gwyddion
            uses. In ``"matching"``, the weights contain a squared height divided by a height, and this ratio
            depends on the unit. In ``"modus"``, rounding errors decide between windows of equal length.
        method: ``median``, ``trimmed-mean`` and ``modus`` shift each row so that the median, trimmed mean or
            modus is the same for all rows. The two ``-of-differences`` methods and ``matching`` estimate the
            step between each pair of neighbouring rows and add up these steps, which preserves large
            features. ``polynomial`` subtracts a polynomial that is fitted to each row separately.
            ``facet-tilt`` removes the prevailing slope of each row, found in up to 30 passes.
        direction: ``"horizontal"`` to align rows, ``"vertical"`` to align columns.
        degree: degree of the polynomial, 0 to 5.
        trim: fraction of the values that trimmed means leave out at each end of the sorted values, 0 to 0.5.
            The value 0.5 gives the median.
        pitch_um: pixel pitch along y and x, needed only by ``facet-tilt``.

    Raises:
        InputError: the method or direction is unknown, the degree or trim is outside its range, or the pitch
            is missing.
    """
    upright = direction == "horizontal"
    lines, usable = (z, chosen) if upright else map(np.ascontiguousarray, (z.T, chosen.T))
    trim = {"median": _MEDIAN_TRIM, "median-of-differences": _MEDIAN_TRIM, "polynomial": 0.0}.get(
        method, trim
    )
    match method:
        case "facet-tilt":
            if pitch_um is None:
                raise InputError("align-rows by facet-tilt needs the pixel pitch", wanted="pitch_um")
            tilts = _facet_tilts(lines, usable, pitch_um[1 if upright else 0])
            removed = np.multiply.outer(tilts, _centred(lines.shape[1]))
        case "polynomial" if degree > 0:
            removed = _row_polynomials(lines, usable, degree)
        case "matching":
            removed = _matching_shifts(lines, usable, last_column_counts=masking == "include")
        case "median-of-differences" | "trimmed-mean-of-differences":
            removed = _difference_shifts(lines, usable, trim)
        case "modus":
            removed = _level_shifts(row_modus(lines, usable), lines, usable, fewest=1)
        case _:
            means = row_trimmed_mean(lines, usable, trim)
            removed = _level_shifts(means, lines, usable, _fewest(lines))
    removed = np.broadcast_to(removed if removed.ndim == 2 else removed[:, None], lines.shape)
    if note := print_taken_for_offsets(lines, removed):
        warnings.warn(note, LevellingWarning, stacklevel=2)
    return subtract(z, removed if upright else removed.T)


def print_taken_for_offsets(z: Array, removed: Array) -> str:
    """Return a warning if an alignment shifted lines that seem to have had no offset. Otherwise return an
    empty string.

    A real offset shifts all pixels of a line. The alignment is suspect if it shifted a line relative to a
    neighbouring line by far more than the noise, although many pixels of the two lines had about the same
    height before. The height difference in the other pixels is then part of a printed structure.

    Args:
        z: heights before the alignment, shape (ny, nx). The rows of the array are the lines.
        removed: surface that the alignment subtracted, shape (ny, nx).
    """
    steps, shifts = np.diff(z, axis=0), np.diff(removed, axis=0)
    noise = _SIGMA_PER_MAD * float(np.nanmedian(np.abs(steps - np.nanmedian(steps, axis=1, keepdims=True))))
    moved = np.abs(shifts) > _CLEAR_SIGMA * max(noise, np.finfo(float).tiny)
    stayed = (moved & (np.abs(steps) < np.abs(shifts) / 2)).mean(axis=1)
    worst = int(stayed.argmax())
    if stayed[worst] < _STAYED:
        return ""
    size = float(np.nanmax(np.abs(shifts[stayed >= _STAYED])))
    shifted = f"lines were shifted by up to {size:.3g} µm, although {stayed[worst]:.0%} of a line's pixels"
    return f"{shifted} had no offset from the next line, so part of the print may be removed"


def _level_shifts(shifts: Array, z: Array, chosen: Array, fewest: int) -> Array:
    """If a row has fewer than ``fewest`` selected pixels, replace its shift by the upper median of all
    selected heights. Return all shifts minus their mean.
    """
    values = np.sort(z[chosen])
    shifts = np.where(chosen.sum(axis=1) < fewest, values[values.size // 2], shifts)
    return shifts - shifts.mean()


def _difference_shifts(z: Array, chosen: Array, trim: float) -> Array:
    both = chosen[1:] & chosen[:-1]
    steps = np.where(both.sum(axis=1) < _fewest(z), 0.0, row_trimmed_mean(np.diff(z, axis=0), both, trim))
    shifts = np.concatenate([[0.0], np.cumsum(steps)])
    # A constant step between rows can be drift of the microscope or a slope of the sample, so the linear part
    # of the shifts stays in the heights.
    row = _centred(len(shifts))
    return shifts - shifts.mean() - row * (row @ shifts) / (row @ row)


def _matching_shifts(z: Array, chosen: Array, last_column_counts: bool) -> Array:
    """Return the shifts of the rows by Gwyddion's method Matching. The step between two neighbouring rows is
    a weighted mean over the pixels, and the shifts are the cumulative sums of the steps, minus their mean.

    Args:
        last_column_counts: whether the last column is used even where it is not selected. Gwyddion does so if
            the mask marks the pixels to include.
    """
    steps_m = np.nan_to_num(np.diff(z, axis=0) * METRE_PER_UM, nan=0.0)
    usable = chosen[1:] & chosen[:-1]
    bends_m = np.diff(steps_m, axis=1)
    scale_m = (np.abs(bends_m) * usable[:, :-1]).sum(axis=1) / bends_m.shape[1]
    weights = np.exp(-(bends_m**2) / (2 * np.where(scale_m > 0, scale_m, 1.0))[:, None]) * usable[:, :-1]
    pixel_weights = np.pad(weights, ((0, 0), (0, 1))) + np.pad(weights, ((0, 0), (1, 0)))
    if last_column_counts:
        usable[:, -1] = np.isfinite(z[1:, -1] - z[:-1, -1])
    total = 2 * weights.sum(axis=1)
    step_m = (pixel_weights * usable * steps_m).sum(axis=1) / np.where(total > 0, total, 1.0)
    shifts = np.concatenate([[0.0], np.cumsum(step_m)]) / METRE_PER_UM
    return shifts - shifts.mean()


def _row_polynomials(z: Array, chosen: Array, degree: int) -> Array:
    """Fit a polynomial to each row. Return the fitted values minus the mean height of all measured pixels,
    masked or not.

    Subtracting the result from the heights therefore adds this mean back, as in Gwyddion.
    """
    basis = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, z.shape[1]), degree)
    fitted = np.zeros(z.shape)
    for i in np.flatnonzero(chosen.sum(axis=1) > degree):
        coefficients, *_ = np.linalg.lstsq(basis[chosen[i]], z[i, chosen[i]], rcond=None)
        fitted[i] = basis @ coefficients
    return fitted - float(np.nanmean(z))


def _facet_tilts(z: Array, chosen: Array, pitch_um: float) -> Array:
    """Return the prevailing slope of each row, in height per pixel, found from pairs of neighbouring selected
    pixels.
    """
    slopes, both = np.diff(z, axis=1) / pitch_um, chosen[:, 1:] & chosen[:, :-1]
    tilts = np.zeros(len(z))
    for i in np.flatnonzero(both.sum(axis=1) >= _FEWEST_SLOPES):
        found = prevailing_slope(slopes[i, both[i]][None], sharpness=1 / 200, passes=30, settled2=1e-12)
        tilts[i] = found[0] * pitch_um
    return tilts


def _fewest(lines: Array) -> int:
    """Return the smallest number of selected values from which a row's shift is estimated."""
    return int(np.log(lines.shape[1]) + 1.5)


def _centred(n: int) -> Array:
    return np.arange(n) - (n - 1) / 2
