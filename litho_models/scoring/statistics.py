"""Compute statistics over scans, or over prints. Pixels of a scan are correlated, so whole scans are
resampled, and sign-flip tests flip whole scans. If the scans of a print share a day and a batch, whole prints
are resampled instead of scans.
"""

from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record

# An interval is None if there are fewer than ``FEWEST_FOR_INTERVAL`` units.
Interval = tuple[float, float] | None
# Smallest number of units for which p can be below 0.05: 2 / 2**5 > 0.05, 2 / 2**6 < 0.05.
FEWEST_FOR_INTERVAL = 6
BOOTSTRAP_DRAWS = 2000
SIGN_FLIP_DRAWS = 9999
PERMUTATIONS = 1999
# The ends of a 95 % interval are written in this way because 0.025 differs in its last bits.
_ENDS = (1 - 0.95) / 2, (1 + 0.95) / 2
# For up to this many scans, every combination of signs is used. Screening tests all directions at once, so
# its limit is one scan lower than in a comparison of two models, which halves its table.
EXACT_SCANS, EXACT_PAIRED_SCANS = 13, 14
# The flips include the observed signs. Rounding must not place their sum below the observed sum.
_ROUNDING = 1 - 1e-12


def rms(values: ArrayLike) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def bootstrap_interval(
    values: Sequence[float],
    *,
    groups: Sequence[Hashable] | None = None,
    draws: int = BOOTSTRAP_DRAWS,
    seed: int = 0,
) -> tuple[float, float]:
    """Return the percentile interval of the mean over scans, from resampling whole scans or whole groups of
    scans.

    A single scan or group cannot be resampled, so both ends are NaN.

    Args:
        values: one per scan.
        groups: the print of each scan, if prints are resampled instead of scans.
    """
    sums, counts = _by_group(values, groups)
    if sums.size < 2:
        return float("nan"), float("nan")
    return _resampled(sums, counts, draws, seed)


def pixel_interval(values: Array, owner: Array, groups: Sequence[Hashable]) -> Interval:
    """Return the confidence interval of a mean over pixels. Whole prints are resampled, and each print is
    weighted by its number of pixels.

    Return None if the pixels come from fewer than ``FEWEST_FOR_INTERVAL`` prints.

    Args:
        values: one per pixel.
        owner: the number of the scan that contains each pixel.
        groups: the print of each scan.
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
    """Return the sum and the number of the values in each group. Without groups, each value is a group of its
    own.
    """
    sample = np.asarray(values, np.float64)
    if groups is None:
        return sample, np.ones(sample.size)
    members = [list(dict.fromkeys(groups)).index(group) for group in groups]
    return np.bincount(members, sample), np.bincount(members).astype(np.float64)


def interval(values: Sequence[float]) -> Interval:
    """Return the result of ``bootstrap_interval``, or None with fewer than ``FEWEST_FOR_INTERVAL`` scans."""
    return bootstrap_interval(values) if len(values) >= FEWEST_FOR_INTERVAL else None


def sign_flips(count: int, seed: int = 0, *, exact_scans: int = EXACT_SCANS) -> Array:
    """Return combinations of signs, (draws, count); the observed signs come first. For up to ``exact_scans``
    scans, all combinations are returned. For more scans, 10,000 combinations are returned.
    """
    if count <= exact_scans:
        return 1.0 - 2.0 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
    drawn = np.random.default_rng(seed).choice([-1.0, 1.0], size=(SIGN_FLIP_DRAWS, count))
    return np.vstack([np.ones(count), drawn])


def one_sided_flip_p(values: Array) -> float:
    """Return the share of sign flips for which the sum of the values is at least the observed sum."""
    return float(np.mean(sign_flips(len(values)) @ values >= values.sum() * _ROUNDING))


def smallest_flip_p(count: int) -> float:
    """Return the smallest two-sided sign-flip p that this many scans or prints allow: 2 divided by the number
    of combinations of signs.

    With six prints, p is at least 2 / 2^6 = 0.031, however large the difference.
    """
    return min(1.0, 2 / 2**count) if count <= EXACT_PAIRED_SCANS else 1 / (SIGN_FLIP_DRAWS + 1)


class OverUnits(Record):
    """The confidence interval and p value of a mean difference over scans, from resampling whole scans or
    prints.

    ``count`` is the number of units, and ``positive`` the number of units with a positive difference.
    ``ci95_nm`` is a bootstrap interval, or None if there are fewer than ``FEWEST_FOR_INTERVAL`` units. ``p``
    is that of a two-sided sign-flip test. For up to 14 units, the test uses all combinations of signs. For
    more units, it uses the observed signs and 9,999 random combinations. ``p`` is never below ``smallest_p``.
    """

    count: int
    positive: int
    ci95_nm: Interval
    p: float
    smallest_p: float


def over_units(
    differences_nm: Sequence[float], groups: Sequence[Hashable] | None = None, seed: int = 0
) -> OverUnits:
    """Test a difference that is given for each scan, by resampling scans. If ``groups`` states the print of
    each scan, whole prints are resampled instead.

    Raises:
        InputError: no difference.
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
    """Test a difference that is given for each scan, by resampling whole prints. Return None if there is only
    one print.
    """
    return over_units(differences_nm, prints, seed) if len(set(prints)) > 1 else None


class ByPrint(Record):
    """A one-way analysis of variance of one estimate per scan, with prints as groups.

    Args:
        f: mean square between prints divided by the mean square within prints.
        degrees: degrees of freedom between prints and within prints.
        icc: share of the variance that scans of one print have in common; a negative estimate is set to 0.
        p: share of permutations of the scans for which ``f`` is at least as large as in the observed order.
            The observed order is one of the permutations.
    """

    f: float
    degrees: tuple[int, int]
    icc: float
    p: float


def by_print(values: Array, prints: Sequence[Hashable], seed: int = 0) -> ByPrint | None:
    """Test whether scans of one print are more similar than scans of different prints.

    Args:
        values: (scans,) or (scans, k) estimates; each column is divided by its spread, so that all columns
            have equal weight.
        prints: print of each scan.

    Returns:
        None if there is only one print, if no print has two scans, or if the estimates are constant.
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
    # Rounding must not place the statistic of the observed order below the observed statistic.
    p = float((ratios >= f * (1 - 1e-12)).mean())
    return ByPrint(f=f, degrees=(between, within), icc=icc, p=p)
