"""One number per row: the order statistics and sums that row alignment uses.

Each function takes (rows, n) values and the selection of the same shape, or None for all of it.
"""

from __future__ import annotations

import numpy as np

# From this trim on, only the median is left.
MEDIAN_TRIM = 0.5
_FEW_FOR_MODUS = 9


def row_counts(values: np.ndarray, chosen: np.ndarray | None) -> np.ndarray:
    """Number of selected values per row, int (rows,)."""
    if chosen is None:
        return np.full(len(values), values.shape[1])
    return np.count_nonzero(chosen, axis=1)


def fewest_for_row(n: int) -> int:
    """How many selected values a row of n needs before its own estimate counts."""
    return int(np.floor(np.log(n) + 1.5))


def row_trimmed_mean(values: np.ndarray, chosen: np.ndarray | None, trim: float) -> np.ndarray:
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


def row_modus(values: np.ndarray, chosen: np.ndarray | None) -> np.ndarray:
    """Mean of the middle third of the shortest window that holds round(sqrt n) sorted values.

    Below 9 values the upper median; a row without selected values gives 0.
    """
    counts = row_counts(values, chosen)
    ordered = np.sort(values if chosen is None else np.where(chosen, values, np.inf), axis=1)
    return np.array([_modus(row[:count]) for row, count in zip(ordered, counts, strict=True)])


def row_facet_tilt(
    values: np.ndarray, chosen: np.ndarray | None, pitch_um: float, sharpness: float
) -> np.ndarray:
    """Slope per pixel of the prevailing 1-D facet of each row, from neighbours that are both selected."""
    slopes = np.diff(values, axis=1) / pitch_um
    usable = np.isfinite(slopes) if chosen is None else chosen[:, 1:] & chosen[:, :-1]
    slopes = np.where(usable, slopes, 0.0)
    spread = (slopes**2).sum(axis=1) / np.maximum(usable.sum(axis=1), 1) * sharpness
    safe = np.where(spread > 0, spread, 1.0)
    weights = np.where(usable, np.exp(-(slopes**2) / safe[:, None]), 0.0)
    total = weights.sum(axis=1)
    return (
        np.where(total > 0, (weights * slopes).sum(axis=1) / np.where(total > 0, total, 1.0), 0.0) * pitch_um
    )


def _dense_trimmed_mean(values: np.ndarray, trim: float) -> np.ndarray:
    n = values.shape[1]
    cut = int(np.floor(trim * n + 0.5))
    if trim >= MEDIAN_TRIM or 2 * cut >= n:
        return np.partition(values, n // 2, axis=1)[:, n // 2]
    if cut == 0:
        return values.mean(axis=1)
    return np.partition(values, (cut, n - cut - 1), axis=1)[:, cut : n - cut].mean(axis=1)


def _modus(ordered: np.ndarray) -> float:
    n = len(ordered)
    if n < _FEW_FOR_MODUS:
        return float(ordered[n // 2]) if n else 0.0
    window = int(np.floor(np.sqrt(n) + 0.5))
    start = int(np.argmin(ordered[window - 1 :] - ordered[: n - window + 1]))
    return float(ordered[start + window // 3 : start + window - window // 3].mean())
