"""Test whether the mean of a monitored quantity has changed since the reference prints, at a given rate of
false alarms.

The test makes one comparison for each new print. The comparison for a print assumes that the mean changes in
a step at this print and stays changed until the last print. A t test with a pooled spread compares the values
before the step, including all reference prints, with the values after the step. Although the mean and the
spread must be estimated from the prints, Student's t distribution holds for any number of reference
prints. The method is the likelihood-ratio test for a step in the mean with unknown parameters (Hawkins, Qiu
and Kang 2003, J. Quality Technology 35, 355). The given rate of false alarms is divided among the comparisons
(Bonferroni). All comparisons together therefore do not exceed this rate, even if they are correlated. A step
should be noticed within ``SOON`` prints, so comparisons with at least ``SOON`` prints after the step get most
of the rate. With three new prints, the test is nearly a t test of the mean of these three prints, which is
the best possible test if the spread is unknown.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.stats import nct
from scipy.stats import t as student

from litho_data.foundation.kinds import Array

# Number of prints within which a step should be noticed.
SOON = 3
# Share of the rate of false alarms that is allotted to each comparison with fewer than ``SOON`` prints after
# the step.
_YOUNG = 0.1
# Largest size of a step that is considered, in units of its standard error.
_LARGEST = 1e4


class Series(NamedTuple):
    """The value of a monitored quantity for each of n reference prints and m new prints, in printing order,
    and the relative variances of these values. The variances are known only up to a factor that is the same
    for all prints. A relative variance is a variance divided by this factor.

    Attributes:
        reference: values of the reference prints, with shape (..., n).
        new: values of the new prints, with shape (..., m).
        reference_variance: relative variances of the values of the reference prints, with shape (n,).
        new_variance: relative variances of the values of the new prints, with shape (m,).
    """

    reference: Array
    new: Array
    reference_variance: Array
    new_variance: Array


class Step(NamedTuple):
    """A step in the mean.

    Attributes:
        since: index of the first new print after the step, counted from 0.
        size: mean after the step minus mean before it.
        ci95: 95 % confidence interval of ``size``.
    """

    since: int
    size: float
    ci95: tuple[float, float]


def shares(new_prints: int) -> Array:
    """Return the share of the rate of false alarms that is allotted to each comparison, with shape (m,).
    There is one comparison for each of the m new prints, in printing order. The shares add up to 1.
    """
    young = min(SOON, new_prints) - 1
    old = new_prints - young
    return np.concatenate([np.full(old, (1 - young * _YOUNG) / old), np.full(young, _YOUNG)])


def step_statistics(series: Series) -> tuple[Array, Array]:
    """For every new print, assume that the mean changes in a step at this print. Return the sizes of these
    steps and their standard errors. Both arrays have shape (m, ...).

    If nothing has changed, the size divided by its standard error follows Student's t with n + m - 2 degrees
    of freedom.
    """
    weight = 1 / np.concatenate([series.reference_variance, series.new_variance])
    # The reference mean is subtracted first, because sums of squares of large values would lose digits.
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
    """Return the most significant step, and an upper bound on its p value.

    Args:
        series: values of one quantity, with shapes (n,) for the reference prints and (m,) for the new prints;
            n is at least 2 and m at least 1.
    """
    sizes, errors = step_statistics(series)
    freedom = len(series.reference) + len(series.new) - 2
    chance = 2 * student.sf(np.abs(sizes / errors), freedom) / shares(len(series.new))
    since = int(np.argmin(chance))
    size, half = float(sizes[since]), float(errors[since] * student.ppf(0.975, freedom))
    return Step(since, size, (size - half, size + half)), min(1.0, float(chance[since]))


def chance_to_notice(step: float, reference_variance: Array, new_variance: Array, rate: float) -> float:
    """Return the probability that a rise of the mean is noticed, i.e. raises an alarm within ``SOON`` prints.
    If there are fewer than ``SOON`` new prints, the alarm must come within the new prints.

    The result is a lower bound, because only one comparison is considered: the step is assumed at the first
    print after the rise. The statistic of this comparison has a noncentral t distribution. All values are
    assumed to be Gaussian.

    Args:
        step: size of the rise, in units of the unknown spread of a print whose relative variance is 1.
        reference_variance: relative variances of the values of the reference prints, with shape (n,).
        new_variance: relative variances of the values of the new prints, with shape (m,).
        rate: probability of a false alarm in at least one of the comparisons.
    """
    limit, freedom, error = _comparison(reference_variance, new_variance, rate)
    return float(nct.sf(limit, freedom, step / error))


def noticeable_step(reference_variance: Array, new_variance: Array, rate: float, power: float = 0.9) -> float:
    """Return the size of a step that raises an alarm with probability ``power``, in units of the spread of a
    print whose relative variance is 1. The result is infinite if this step exceeds ten thousand standard
    errors. All arguments except ``power`` have the same meaning as in ``chance_to_notice``.
    """
    error = _comparison(reference_variance, new_variance, rate)[2]

    def beyond(errors: float) -> float:
        return chance_to_notice(errors * error, reference_variance, new_variance, rate) - power

    return error * float(brentq(beyond, 0, _LARGEST)) if beyond(_LARGEST) > 0 else float("inf")


def _comparison(reference_variance: Array, new_variance: Array, rate: float) -> tuple[float, int, float]:
    """Return three numbers for the comparison of the last ``SOON`` prints with all prints before them. They
    are the value of t above which an alarm is raised, the degrees of freedom of t, and the standard error of
    the step.
    """
    n, m = len(reference_variance), len(new_variance)
    soon = min(SOON, m)
    before = (1 / reference_variance).sum() + (1 / new_variance[: m - soon]).sum()
    after = (1 / new_variance[m - soon :]).sum()
    freedom = n + m - 2
    limit = float(student.isf(rate * shares(m)[m - soon] / 2, freedom))
    return limit, freedom, float(np.sqrt(1 / before + 1 / after))
