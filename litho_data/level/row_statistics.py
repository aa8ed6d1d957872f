"""Compute the trimmed mean or the modus (an estimate of the most frequent value) of the selected values in
each row.
"""

import numpy as np

from litho_data.foundation import Array

_FEW_FOR_MODUS = 9
METRE_PER_UM = 1e-6
# Heights in metres are rounded to this many significant digits. Files state fewer digits, so the rounding
# removes only the errors of unit conversions.
_DECIMAL_DIGITS = 12
# Powers of ten up to this exponent are exact in double precision.
_LARGEST_EXACT_POWER = 22


def row_trimmed_mean(values: Array, chosen: Array, trim: float) -> Array:
    """Return the trimmed mean of each row: the mean of sorted[t : n - t], where ``sorted`` contains the n
    selected values of the row in ascending order and t = floor(trim n + 0.5).

    If this slice is empty, the result is the upper median sorted[n // 2], which for even n is the larger of
    the two middle values. The result is 0 for a row without selected values.
    """
    counts = chosen.sum(axis=1)
    # Unselected values become infinite, so that sorting places them last.
    ordered = np.sort(np.where(chosen, values, np.inf), axis=1)
    cut = np.floor(trim * counts + 0.5).astype(int)
    first = np.where(2 * cut >= counts, counts // 2, cut)
    last = np.where(2 * cut >= counts, counts // 2 + 1, counts - cut)
    position = np.arange(values.shape[1])
    kept = (position >= first[:, None]) & (position < np.minimum(last, counts)[:, None])
    return np.where(kept, ordered, 0.0).sum(axis=1) / np.maximum(kept.sum(axis=1), 1)


def row_modus(values: Array, chosen: Array) -> Array:
    """Return the modus of each row, which is an estimate of the most frequent of its values.

    The n selected values of a row are sorted. A window contains round(sqrt n) consecutive sorted values, and
    its length is the difference between its last and its first value. The modus is the mean of the middle
    third of the shortest window. For a row with fewer than 9 selected values, the result is the upper median.
    It is 0 for a row without selected values.

    If heights have few digits, several windows often have the same length, and rounding errors would decide
    which is the shortest. Gwyddion compares the lengths in metres. This function therefore converts the
    values to metres and rounds them to 12 digits, so that it chooses the same window as Gwyddion for every
    unit of the file.
    """
    return np.array([_modus(np.sort(row[use])) for row, use in zip(values, chosen, strict=True)])


def _modus(ordered: Array) -> float:
    n = len(ordered)
    if n < _FEW_FOR_MODUS:
        return float(ordered[n // 2]) if n else 0.0
    metres, window = _decimal_metres(ordered), int(np.sqrt(n) + 0.5)
    start = int(np.argmin(metres[window - 1 :] - metres[: n - window + 1]))
    return float(ordered[start + window // 3 : start + window - window // 3].mean())


def _decimal_metres(height_um: Array) -> Array:
    """Return the heights in metres, as if read from a file with up to 12 significant digits."""
    metres = height_um * METRE_PER_UM
    with np.errstate(divide="ignore"):
        exponent = np.nan_to_num(np.floor(np.log10(np.abs(metres))), neginf=0.0)
    power = np.clip(_DECIMAL_DIGITS - 1 - exponent, 0, _LARGEST_EXACT_POWER)
    scale = 10.0 ** np.arange(_LARGEST_EXACT_POWER + 1)
    return np.rint(metres * scale[power.astype(int)]) / scale[power.astype(int)]
