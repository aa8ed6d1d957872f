"""One number per row: the order statistics and sums that row alignment uses.

Each function takes (rows, n) values and the selection of the same shape, or None for all of it.
"""

import numpy as np

from litho_data.foundation.kinds import Array

# From this trim on, only the median is left.
MEDIAN_TRIM = 0.5
_FEW_FOR_MODUS = 9
METRE_PER_UM = 1e-6
# Digits of heights in metres: more than files state, fewer than converting units changes.
_DECIMAL_DIGITS = 12
# Powers of ten up to here are exact in a double.
_LARGEST_EXACT_POWER = 22
_FACET_SHARPNESS, _FACET_PASSES, _FACET_SMALLEST_STEP = 1 / 200, 30, 1e-6
_FEWEST_SLOPES = 4


def row_counts(values: Array, chosen: Array | None) -> Array:
    """Number of selected values per row, int (rows,)."""
    if chosen is None:
        return np.full(len(values), values.shape[1])
    return np.count_nonzero(chosen, axis=1)


def fewest_for_row(n: int) -> int:
    """How many selected values a row of n needs before its own estimate counts."""
    return int(np.floor(np.log(n) + 1.5))


def row_trimmed_mean(values: Array, chosen: Array | None, trim: float) -> Array:
    """Mean of sorted[t : n - t], t = floor(trim n + 0.5); from trim 0.5 on sorted[n // 2].

    For even n that upper median differs from the mean of the two middle values. A row without
    selected values gives 0.
    """
    if chosen is None:
        return _dense_trimmed_mean(values, trim)
    counts = row_counts(values, chosen)
    # Unselected values sort behind all others.
    ordered = np.sort(np.where(chosen, values, np.inf), axis=1)
    cut = np.floor(trim * counts + 0.5).astype(int)
    median_only = 2 * cut >= counts if trim < MEDIAN_TRIM else np.ones(len(counts), dtype=bool)
    first = np.where(median_only, counts // 2, cut)
    last = np.where(median_only, counts // 2 + 1, counts - cut)
    position = np.arange(values.shape[1])
    kept = (position >= first[:, None]) & (position < np.minimum(last, counts)[:, None])
    return np.where(kept, ordered, 0.0).sum(axis=1) / np.maximum(kept.sum(axis=1), 1)


def row_modus(values: Array, chosen: Array | None) -> Array:
    """Mean of the middle third of the shortest window that holds round(sqrt n) sorted values.

    Below 9 values the upper median; a row without selected values gives 0. Windows of heights with few
    digits are often equally short. Gwyddion takes the one that comes out shortest in metres, so values (µm)
    are compared in metres, rounded to 12 digits: no unit of a file changes the choice.
    """
    counts = row_counts(values, chosen)
    ordered = np.sort(values if chosen is None else np.where(chosen, values, np.inf), axis=1)
    metres = _decimal_metres(ordered)
    rows = zip(ordered, metres, counts, strict=True)
    return np.array([_modus(row[:count], row_m[:count]) for row, row_m, count in rows])


def row_facet_tilt(values: Array, chosen: Array | None, pitch_um: float) -> Array:
    """Slope per pixel of the prevailing 1-D facet of each row, from neighbours that are both selected.

    Each row is levelled up to 30 times, until its slope changes by less than 1e-6.
    """
    slopes = np.diff(values, axis=1) / pitch_um
    usable = np.isfinite(slopes) if chosen is None else chosen[:, 1:] & chosen[:, :-1]
    return np.array([_facet_slope(row[use]) for row, use in zip(slopes, usable, strict=True)]) * pitch_um


def _facet_slope(slopes: Array) -> float:
    total = 0.0
    if len(slopes) < _FEWEST_SLOPES:
        return total
    for _ in range(_FACET_PASSES):
        squares = slopes * slopes
        spread = float(squares.mean()) * _FACET_SHARPNESS
        if spread == 0.0:
            break
        weights = np.exp(squares / -spread)
        step = float(weights @ slopes) / float(weights.sum())
        slopes = slopes - step
        total += step
        if abs(step) < _FACET_SMALLEST_STEP:
            break
    return total


def _dense_trimmed_mean(values: Array, trim: float) -> Array:
    n = values.shape[1]
    cut = int(np.floor(trim * n + 0.5))
    if trim >= MEDIAN_TRIM or 2 * cut >= n:
        return np.partition(values, n // 2, axis=1)[:, n // 2]
    if cut == 0:
        return values.mean(axis=1)
    return np.partition(values, (cut, n - cut - 1), axis=1)[:, cut : n - cut].mean(axis=1)


def _modus(ordered: Array, metres: Array) -> float:
    n = len(ordered)
    if n < _FEW_FOR_MODUS:
        return float(ordered[n // 2]) if n else 0.0
    window = int(np.floor(np.sqrt(n) + 0.5))
    start = int(np.argmin(metres[window - 1 :] - metres[: n - window + 1]))
    return float(ordered[start + window // 3 : start + window - window // 3].mean())


def _decimal_metres(height_um: Array) -> Array:
    """The doubles that a file in metres with up to 12 digits would have been read as."""
    metres = height_um * METRE_PER_UM
    with np.errstate(divide="ignore", invalid="ignore"):
        exponent = np.nan_to_num(np.floor(np.log10(np.abs(metres))), posinf=0.0, neginf=0.0)
        power = np.clip(_DECIMAL_DIGITS - 1 - exponent, 0, _LARGEST_EXACT_POWER)
        scale = (10.0 ** np.arange(_LARGEST_EXACT_POWER + 1))[power.astype(int)]
        return np.rint(metres * scale) / scale
