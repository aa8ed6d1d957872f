"""Confidence intervals and tests that treat scans or prints as independent units. The pixels of a scan are
correlated, so whole scans are resampled, and a sign-flip test flips one sign per scan. If a dataset has
several scans per print, these scans may share a day and a batch. In this case, prints are the units instead
of scans.
"""

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record

# The ends of a confidence interval, or None if there are fewer than FEWEST_FOR_INTERVAL units.
Interval = tuple[float, float] | None
# Smallest number of units for which the p value of a sign-flip test can be below 0.05: 2 / 2**5 > 0.05, but 2
# / 2**6 < 0.05.
FEWEST_FOR_INTERVAL = 6
BOOTSTRAP_DRAWS = 2000
SIGN_FLIP_DRAWS = 9999
PERMUTATIONS = 1999
# The quantiles at the ends of a 95 % interval. They are written in this way because 0.025 would differ in its
# last bits, which would change published results.
_ENDS = (1 - 0.95) / 2, (1 + 0.95) / 2
# Largest number of scans for which a test uses every combination of signs: the first value is for screening,
# and the second for a comparison of two models. Screening tests all candidates at once and therefore needs
# more memory. The limit for screening is one scan lower, which halves the table of signs.
EXACT_SCANS, EXACT_PAIRED_SCANS = 13, 14
# The combinations of signs include the observed signs. With this factor, rounding errors cannot exclude the
# observed signs from the combinations that are counted.
_ROUNDING = 1 - 1e-12


def rms(values: ArrayLike) -> float:
    """Return the root mean square of the values."""
    return float(np.sqrt(np.mean(np.square(values))))


def bootstrap_interval(
    values: Sequence[float],
    *,
    groups: Sequence[Hashable] | None = None,
    draws: int = BOOTSTRAP_DRAWS,
    seed: int = 0,
) -> tuple[float, float]:
    """Return the 95 % bootstrap confidence interval (percentiles) of the mean over scans. Whole scans, or
    whole groups of scans, are resampled.

    If there is only one scan or group, both ends are NaN, because it cannot be resampled.

    Args:
        values: one value per scan.
        groups: print of each scan. If it is given, whole prints are resampled instead of scans.
    """
    sums, counts = _by_group(values, groups)
    if sums.size < 2:
        return float("nan"), float("nan")
    return _resampled(sums, counts, draws, seed)


def pixel_interval(values: Array, owner: Array, groups: Sequence[Hashable]) -> Interval:
    """Return the 95 % confidence interval of a mean over pixels. Whole prints are resampled, and each print
    has a weight equal to its number of pixels.

    Return None if the pixels come from fewer than ``FEWEST_FOR_INTERVAL`` prints.

    Args:
        values: one value per pixel.
        owner: number of the scan that contains the pixel, for each pixel.
        groups: print of each scan.
    """
    sums, counts = (
        _by_group(np.bincount(owner, own, minlength=len(groups)), groups)[0] for own in (values, None)
    )
    seen = counts > 0
    if seen.sum() < FEWEST_FOR_INTERVAL:
        return None
    return _resampled(sums[seen], counts[seen], BOOTSTRAP_DRAWS, 0)


def _resampled(sums: Array, counts: Array, draws: int, seed: int) -> tuple[float, float]:
    picks = np.random.default_rng(seed).integers(0, sums.size, size=(draws, sums.size))
    means = sums[picks].sum(axis=1) / counts[picks].sum(axis=1)
    low, high = np.quantile(means, _ENDS)
    return float(low), float(high)


def _by_group(values: ArrayLike, groups: Sequence[Hashable] | None) -> tuple[Array, Array]:
    """Return the sum and the number of the values in each group. If ``groups`` is None, each value is a group
    of its own.
    """
    sample = np.asarray(values, np.float64)
    if groups is None:
        return sample, np.ones(sample.size)
    members = [list(dict.fromkeys(groups)).index(group) for group in groups]
    return np.bincount(members, sample), np.bincount(members).astype(np.float64)


def interval(values: Sequence[float]) -> Interval:
    """Return ``bootstrap_interval(values)``, or None for fewer than ``FEWEST_FOR_INTERVAL`` scans."""
    return bootstrap_interval(values) if len(values) >= FEWEST_FOR_INTERVAL else None


def sign_flips(count: int, seed: int = 0, *, exact_scans: int = EXACT_SCANS) -> Array:
    """Return combinations of signs for a sign-flip test, with shape (combinations, count). The first row
    contains the observed signs, which are all +1. For up to ``exact_scans`` scans, all combinations are
    returned. For more scans, the observed signs and 9,999 random combinations are returned.
    """
    if count <= exact_scans:
        return 1.0 - 2.0 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
    drawn = np.random.default_rng(seed).choice([-1.0, 1.0], size=(SIGN_FLIP_DRAWS, count))
    return np.vstack([np.ones(count), drawn])


def one_sided_flip_p(values: Array) -> float:
    """Return the one-sided p value of a sign-flip test. It is the share of sign combinations that give at
    least the observed sum of the values.
    """
    return float(np.mean(sign_flips(len(values)) @ values >= values.sum() * _ROUNDING))


def smallest_flip_p(count: int) -> float:
    """Return the smallest p value that a two-sided sign-flip test of this many scans or prints can give. If
    all combinations of signs are used, this p value is 2 divided by the number of combinations.

    With six prints, for example, p is at least 2 / 2^6 = 0.031, however large the difference.
    """
    return min(1.0, 2 / 2**count) if count <= EXACT_PAIRED_SCANS else 1 / (SIGN_FLIP_DRAWS + 1)


class OverUnits(Record):
    """The confidence interval and the p value of a difference that is averaged over scans. The independent
    units are scans or prints.

    ``count`` is the number of units, and ``positive`` is the number of units with a positive difference.
    ``ci95_nm`` is a bootstrap interval, or None if there are fewer than ``FEWEST_FOR_INTERVAL`` units. ``p``
    is the p value of a two-sided sign-flip test. For up to 14 units, the test uses all combinations of signs.
    For more units, it uses the observed signs and 9,999 random combinations. ``smallest_p`` is the smallest p
    value that this test can give.
    """

    count: int
    positive: int
    ci95_nm: Interval
    p: float
    smallest_p: float


def over_units(
    differences_nm: Sequence[float], groups: Sequence[Hashable] | None = None, seed: int = 0
) -> OverUnits:
    """Test whether the mean of differences is farther from zero than chance explains. ``differences_nm`` has
    one value per scan. The independent units are scans. If ``groups`` states the print of each scan, the
    independent units are prints.

    Raises:
        InputError: no difference is given.
    """
    if not len(differences_nm):
        raise InputError("differences", got="none", wanted="one for each scan")
    sums, _ = _by_group(differences_nm, groups)
    flipped = np.abs(sign_flips(sums.size, seed, exact_scans=EXACT_PAIRED_SCANS) @ sums)
    enough = sums.size >= FEWEST_FOR_INTERVAL
    return OverUnits(
        count=sums.size,
        positive=int((sums > 0).sum()),
        ci95_nm=bootstrap_interval(differences_nm, groups=groups, seed=seed) if enough else None,
        p=float(np.mean(flipped >= abs(sums.sum()) * _ROUNDING)),
        smallest_p=smallest_flip_p(sums.size),
    )


def over_prints(differences_nm: Sequence[float], prints: Sequence[str], seed: int = 0) -> OverUnits | None:
    """Call ``over_units`` with prints as units. Return None if there is only one print."""
    return over_units(differences_nm, prints, seed) if len(set(prints)) > 1 else None


class ByPrint(Record):
    """A one-way analysis of variance of one estimate per scan, with prints as groups.

    Args:
        f: F statistic, i.e. the mean square between prints divided by the mean square within prints.
        degrees: degrees of freedom between prints and within prints.
        icc: intraclass correlation, which is the share of the variance that comes from differences between
            prints. A negative estimate is set to 0.
        p: p value of a permutation test: the share of permutations of the scans for which ``f`` is at least
            as large as in the observed order. The observed order is one of the permutations.
    """

    f: float
    degrees: tuple[int, int]
    icc: float
    p: float


def by_print(values: Array, prints: Sequence[Hashable], seed: int = 0) -> ByPrint | None:
    """Test whether scans of the same print are more alike than scans of different prints.

    Args:
        values: estimates for each scan, of shape (scans,) or (scans, k). Each column is divided by its
            standard deviation, so that all columns have equal weight.
        prints: print of each scan.

    Returns:
        The analysis, or None if there is only one print, if no print has two scans, or if the estimates are
            constant.
    """
    names, members = np.unique(np.asarray(prints, str), return_inverse=True)
    columns = np.reshape(values, (len(members), -1)).astype(np.float64)
    columns = columns - columns.mean(axis=0)
    spread = columns.std(axis=0)
    columns = columns[:, spread > 0] / spread[spread > 0]
    between, within = len(names) - 1, len(members) - len(names)
    if not between or not within or not columns.size:
        return None
    counts = np.bincount(members)
    of_print = (members == np.arange(len(names))[:, None]) / np.sqrt(counts)[:, None]
    orders = np.random.default_rng(seed).random((PERMUTATIONS, len(members))).argsort(axis=1)
    orders = np.concatenate([np.arange(len(members))[None], orders])
    explained = (np.einsum("gn,pnk->pgk", of_print, columns[orders], optimize=True) ** 2).sum(axis=(1, 2))
    rest = np.maximum(float((columns**2).sum()) - explained, np.finfo(float).tiny)
    ratios = explained / between / (rest / within)
    f = float(ratios[0])
    size = (len(members) - float((counts**2).sum()) / len(members)) / between
    icc = max((f - 1) / (f + size - 1), 0.0)
    # With this factor, rounding errors cannot exclude the observed order from the permutations that are
    # counted.
    p = float((ratios >= f * (1 - 1e-12)).mean())
    return ByPrint(f=f, degrees=(between, within), icc=icc, p=p)
