"""Has the mean of a figure changed since the reference? A test with a stated rate of false alarms.

Prints are taken one after the other. After each, every print since the reference is tried as the first of a
new level: the figures before it, the reference among them, against those from it on, by Student's t with the
spread pooled. Mean and spread are unknown, and the t distribution holds for any number of reference prints;
unchanged new prints join the reference. This is the likelihood ratio for a step in the mean with unknown
parameters (Hawkins, Qiu and Kang 2003, J. Quality Technology 35, 355). The threshold is in closed form: each
of the m(m + 1)/2 comparisons of m new prints gets the same share of the rate, which then holds for the whole
set (Bonferroni), however the comparisons are correlated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

# Prints within which the size of a noticeable step is stated.
SOON = 3
_DRAWS, _SEED = 4000, 0
_LARGEST_STEP = 1e3


class Series(NamedTuple):
    """One figure per print in printing order, and its variance up to a common factor.

    Attributes:
        reference: (..., n); ``new``: (..., m).
        reference_variance: (n,); ``new_variance``: (m,).
    """

    reference: np.ndarray
    new: np.ndarray
    reference_variance: np.ndarray
    new_variance: np.ndarray


class Step(NamedTuple):
    """A step in the mean.

    Attributes:
        noticed: number of the new print, from 0, after which it was noticed.
        since: that of the first changed one.
        size: new mean minus old; ``ci95``: its interval.
        p: two-sided chance of a t as large at one given print.
    """

    noticed: int
    since: int
    size: float
    ci95: tuple[float, float]
    p: float


def comparisons(new_prints: int) -> int:
    """How many pairs of a last print and a first changed one there are."""
    return new_prints * (new_prints + 1) // 2


def step_statistics(series: Series) -> tuple[np.ndarray, np.ndarray]:
    """Step and its t for every pair of a last print and a first changed one.

    Returns:
        Sizes and t, (m, m, ...) each: [last, first]; NaN where first > last. The degrees of freedom of t are
        n + last - 1.
    """
    weight = 1 / np.concatenate([series.reference_variance, series.new_variance])
    # About a value within the data, or the sums of squares would lose their digits.
    centre = np.mean(series.reference, axis=-1, keepdims=True)
    values = np.concatenate([series.reference - centre, series.new - centre], axis=-1)
    n, m = series.reference.shape[-1], series.new.shape[-1]
    total = np.cumsum(weight)
    sums = np.cumsum(weight * values, axis=-1)
    squares = np.cumsum(weight * values**2, axis=-1)
    sizes, found = (np.full((m, m, *values.shape[:-1]), np.nan) for _ in range(2))
    for last in range(m):
        end = n + last
        for first in range(last + 1):
            before, after = total[n + first - 1], total[end] - total[n + first - 1]
            low, high = sums[..., n + first - 1], sums[..., end] - sums[..., n + first - 1]
            size = high / after - low / before
            within = squares[..., end] - low**2 / before - high**2 / after
            variance = np.maximum(within, np.finfo(float).tiny) / (n + last - 1)
            sizes[last, first] = size
            found[last, first] = size / np.sqrt(variance * (1 / before + 1 / after))
    return sizes, found


def first_step(series: Series, rate: float) -> tuple[Step | None, float]:
    """The first step that is noticed, None without one; and the smallest p of all comparisons.

    Args:
        series: values of shape (n,) and (m,), n at least 2, m at least 1.
        rate: chance of a false alarm in the whole set.
    """
    sizes, found = step_statistics(series)
    n, m = len(series.reference), len(series.new)
    freedom = n + np.arange(m) - 1
    chance = 2 * student.sf(np.abs(found), freedom[:, None])
    smallest = float(np.nanmin(chance))
    for last in range(m):
        first = int(np.nanargmin(chance[last]))
        p = float(chance[last, first])
        if p <= rate / comparisons(m):
            size = float(sizes[last, first])
            half = abs(size / float(found[last, first])) * float(student.ppf(0.975, freedom[last]))
            return Step(last, first, size, (size - half, size + half), p), smallest
    return None, smallest


def noticed_share(series: Series, rate: float) -> np.ndarray:
    """Whether each of many sets raises an alarm within ``SOON`` new prints, bool (...)."""
    n, m = series.reference.shape[-1], series.new.shape[-1]
    soon = min(m, SOON)
    head = series._replace(new=series.new[..., :soon], new_variance=series.new_variance[:soon])
    _, found = step_statistics(head)
    limit = student.isf(rate / comparisons(m) / 2, n + np.arange(soon) - 1)
    largest = np.nanmax(np.abs(found), axis=1)
    return (largest >= limit.reshape(-1, *[1] * (largest.ndim - 1))).any(axis=0)


def noticeable_step(
    reference_variance: np.ndarray, new_variance: np.ndarray, rate: float, power: float = 0.9
) -> float:
    """The step from the first new print on that is noticed within ``SOON`` prints with a chance of ``power``.

    In units of the spread of a figure whose variance is 1; by simulation of Gaussian figures. Infinite where
    no step of a thousand spreads would be.
    """
    random = np.random.default_rng(_SEED)
    reference = random.normal(size=(_DRAWS, len(reference_variance))) * np.sqrt(reference_variance)
    new = random.normal(size=(_DRAWS, len(new_variance))) * np.sqrt(new_variance)

    def noticed(step: float) -> float:
        moved = Series(reference, new + step, reference_variance, new_variance)
        return float(noticed_share(moved, rate).mean())

    low, high = 0.0, 1.0
    while noticed(high) < power:
        low, high = high, 2 * high
        if high > _LARGEST_STEP:
            return float("inf")
    while high - low > 0.01 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if noticed(middle) < power else (low, middle)
    return high
