"""When to measure again: how soon the fastest drift that the prints leave open reaches a tolerance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import t as student


class Trend(NamedTuple):
    """A straight line through the figures of prints.

    Attributes:
        per_print: change from print to print, with its 95 % interval.
        p: two-sided chance of as much without a trend.
        prints_left: so many more prints keep the 95 % bound of the drift within the tolerance.
    """

    per_print: float
    ci95: tuple[float, float]
    p: float
    prints_left: int


def forecast(values: np.ndarray, variance: np.ndarray, reference: np.ndarray, tolerance: float) -> Trend:
    """Trend over all prints, and how far it may be trusted.

    Drift is the change since the middle of the reference, where the model was made: the trend times the
    number of prints since. Its 95 % bound is that of the faster end of the interval of the trend. A steady
    drift is assumed; a step is what the alarm is for.

    Args:
        values: one per print in printing order, (n,), three at least; ``variance``: relative, (n,).
        reference: bool (n,), which prints are of the reference.
        tolerance: largest drift, in the unit of ``values``.
    """
    n, weight = len(values), 1 / variance
    place = np.arange(n)
    away = place - np.average(place, weights=weight)
    power = float((weight * away**2).sum())
    slope = float((weight * away * values).sum()) / power
    rest = values - np.average(values, weights=weight) - slope * away
    error = float(np.sqrt((weight * rest**2).sum() / (n - 2) / power))
    half = float(student.ppf(0.975, n - 2)) * error
    fastest = max(abs(slope - half), abs(slope + half))
    since_middle = n - 1 - float(place[reference].mean())
    # Beyond a million prints the number says nothing.
    left = int(np.clip(tolerance / fastest - since_middle, 0, 1e6)) if fastest > 0 else 10**6
    p = 2 * float(student.sf(abs(slope) / error, n - 2)) if error > 0 else float(slope == 0)
    return Trend(slope, (slope - half, slope + half), p, left)
