"""Test whether the mean of a monitored quantity has changed since the reference, at a stated rate of false
alarms.

The test assumes in turn that each new print is the first print after a step, and that the step lasts until
the last print. Student's t with a pooled spread compares the values before the step, including the reference,
with the values after it. The t distribution is valid for any number of reference prints, although their mean
and spread are unknown. The test is the likelihood ratio for a step in the mean with unknown parameters
(Hawkins, Qiu and Kang 2003, J. Quality Technology 35, 355). The rate of false alarms is divided among the
comparisons, so it holds for the whole set, whatever the correlation between comparisons (Bonferroni). A step
should be noticed within ``SOON`` prints, so comparisons with at least that many prints after the step get
most of the rate. With three new prints, the rule is nearly the t test of their mean, which is the best
possible test if the spread is unknown.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.stats import nct
from scipy.stats import t as student

from litho_data.foundation.kinds import Array

# Number of prints within which a step should be noticed.
SOON = 3
# Share of the rate of false alarms for each comparison with fewer than ``SOON`` prints after the step.
_YOUNG = 0.1
# Steps larger than this, in standard errors, are not searched for.
_LARGEST = 1e4


class Series(NamedTuple):
    """The value of each print in printing order, and the variance of each value up to a common factor.

    Attributes:
        reference: values of the reference prints, (..., n).
        new: values of the new prints, (..., m).
        reference_variance: relative variances of the reference prints, (n,).
        new_variance: relative variances of the new prints, (m,).
    """

    reference: Array
    new: Array
    reference_variance: Array
    new_variance: Array


class Step(NamedTuple):
    """A step in the mean.

    Attributes:
        since: index of the first new print after the step, counted from 0.
        size: new mean minus old mean.
        ci95: confidence interval of ``size``.
    """

    since: int
    size: float
    ci95: tuple[float, float]


def shares(new_prints: int) -> Array:
    """Return the share of the rate of false alarms that each comparison gets, (m,). The comparisons are in
    the order of their first changed print. The shares add up to 1.
    """
    young = min(SOON, new_prints) - 1
    old = new_prints - young
    return np.concatenate([np.full(old, (1 - young * _YOUNG) / old), np.full(young, _YOUNG)])


def step_statistics(series: Series) -> tuple[Array, Array]:
    """Return the step and its standard error for every possible first changed print. Both arrays have the
    shape (m, ...).

    If nothing has changed, the ratio of step to standard error follows Student's t with n + m - 2 degrees of
    freedom.
    """
    weight = 1 / np.concatenate([series.reference_variance, series.new_variance])
    # A value within the data is subtracted first, because sums of squares of large values would lose digits.
    centre = np.mean(series.reference, axis=-1, keepdims=True)
    values = np.concatenate([series.reference - centre, series.new - centre], axis=-1)
    n, m = series.reference.shape[-1], series.new.shape[-1]
    total, sums = weight.sum(), (weight * values).sum(axis=-1)
    squares = (weight * values**2).sum(axis=-1)
    before = np.cumsum(weight)[n - 1 : -1]
    low = np.moveaxis(np.cumsum(weight * values, axis=-1)[..., n - 1 : -1], -1, 0)
    before = before.reshape(m, *[1] * (low.ndim - 1))
    after, high = total - before, sums - low
    within = squares - low**2 / before - high**2 / after
    variance = np.maximum(within, np.finfo(float).tiny) / (n + m - 2)
    return high / after - low / before, np.sqrt(variance * (1 / before + 1 / after))


def likeliest_step(series: Series) -> tuple[Step, float]:
    """Find the most significant step, and an upper bound on its p value.

    Args:
        series: values of shape (n,) and (m,), n at least 2, m at least 1.
    """
    sizes, errors = step_statistics(series)
    freedom = len(series.reference) + len(series.new) - 2
    chance = 2 * student.sf(np.abs(sizes / errors), freedom) / shares(len(series.new))
    since = int(np.argmin(chance))
    size, half = float(sizes[since]), float(errors[since] * student.ppf(0.975, freedom))
    return Step(since, size, (size - half, size + half)), min(1.0, float(chance[since]))


def chance_to_notice(step: float, reference_variance: Array, new_variance: Array, rate: float) -> float:
    """Return the probability that a rise causes an alarm within ``SOON`` prints, or within all new prints if
    there are fewer.

    The result is a lower bound. It is computed from the noncentral t distribution of a single comparison, the
    one in which the step starts with the rise.

    Args:
        step: the rise, in units of the unknown spread. A print with this spread has a relative variance of 1.
        reference_variance: relative variances of the reference prints, (n,). All values are Gaussian.
        new_variance: relative variances of the new prints, (m,).
        rate: chance of a false alarm in the whole set.
    """
    limit, freedom, error = _comparison(reference_variance, new_variance, rate)
    return float(nct.sf(limit, freedom, step / error))


def noticeable_step(reference_variance: Array, new_variance: Array, rate: float, power: float = 0.9) -> float:
    """Return the step that is noticed with probability ``power``; infinite if it exceeds ten thousand
    standard errors.
    """
    error = _comparison(reference_variance, new_variance, rate)[2]

    def beyond(errors: float) -> float:
        return chance_to_notice(errors * error, reference_variance, new_variance, rate) - power

    return error * float(brentq(beyond, 0, _LARGEST)) if beyond(_LARGEST) > 0 else float("inf")


def _comparison(reference_variance: Array, new_variance: Array, rate: float) -> tuple[float, int, float]:
    """Return the limit of t, the degrees of freedom and the standard error for a comparison of the last
    ``SOON`` prints with all prints before them.
    """
    n, m = len(reference_variance), len(new_variance)
    soon = min(SOON, m)
    before = (1 / reference_variance).sum() + (1 / new_variance[: m - soon]).sum()
    after = (1 / new_variance[m - soon :]).sum()
    freedom = n + m - 2
    limit = float(student.isf(rate * shares(m)[m - soon] / 2, freedom))
    return limit, freedom, float(np.sqrt(1 / before + 1 / after))
