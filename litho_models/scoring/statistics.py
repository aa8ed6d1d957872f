"""Statistics over scans. Pixels of a scan are correlated: every draw and every sign is of a whole scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from litho_data.foundation.errors import InputError

# With fewer, no arrangement of signs is as rare as one in 20: 2 / 2**5 > 0.05, 2 / 2**6 < 0.05.
FEWEST_FOR_INTERVAL = 6
BOOTSTRAP_DRAWS = 2000
SIGN_FLIP_DRAWS = 9999
# Up to so many scans every combination of signs is used. A table of 2^14 rows is the larger for all
# directions of a screening at once, so that stops one scan earlier than the comparison of two models.
EXACT_SCANS, EXACT_PAIRED_SCANS = 13, 14
# The observed signs are among the flips; rounding must not put a sum below itself.
_ROUNDING = 1 - 1e-12


def bootstrap_interval(
    values: Sequence[float], *, level: float = 0.95, draws: int = BOOTSTRAP_DRAWS, seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of the mean over scans, resampling whole scans.

    With one scan there is nothing to resample: both ends are NaN.
    """
    sample = np.asarray(values, np.float64)
    if sample.size < 2:
        return float("nan"), float("nan")
    picks = np.random.default_rng(seed).integers(0, sample.size, size=(draws, sample.size))
    means = sample[picks].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def interval(values: Sequence[float]) -> tuple[float, float] | None:
    """As ``bootstrap_interval``, for results: None with fewer than ``FEWEST_FOR_INTERVAL`` scans."""
    return bootstrap_interval(values) if len(values) >= FEWEST_FOR_INTERVAL else None


def sign_flips(count: int, seed: int = 0, *, exact_scans: int = EXACT_SCANS) -> np.ndarray:
    """Signs (draws, count), the observed ones first: all of them up to ``exact_scans``, 10,000 beyond."""
    if count <= exact_scans:
        return 1.0 - 2.0 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
    drawn = np.random.default_rng(seed).choice([-1.0, 1.0], size=(SIGN_FLIP_DRAWS, count))
    return np.vstack([np.ones(count), drawn])


def one_sided_flip_p(values: np.ndarray, seed: int = 0) -> float:
    """Share of sign flips of the scans' values whose sum reaches the observed one."""
    return float(np.mean(sign_flips(len(values), seed) @ values >= values.sum() * _ROUNDING))


def sign_flip_statistics(scores: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Cluster-robust z of each column of (scans, columns), and the null distribution of max |z|.

    z = sum s / sqrt(F/(F-1) sum (s - mean)²). The null flips scans, the same flip for all columns:
    see ``sign_flips``.
    """
    count = len(scores)
    signs = sign_flips(count, seed)
    sums = signs @ scores
    squares = (scores**2).sum(axis=0)
    # A column of equal scores would divide by zero; z is capped where the spread vanishes.
    spread = np.maximum(squares - sums**2 / count, 1e-6 * squares + np.finfo(float).tiny)
    z = sums / np.sqrt(count / max(count - 1, 1) * spread)
    return z[0], np.abs(z).max(axis=1)


def family_wise_p(z: float, null_max: np.ndarray) -> float:
    """Share of sign flips whose largest |z| reaches this one."""
    return float(np.mean(null_max >= abs(z) * (1 - 1e-9)))


@dataclass(frozen=True)
class PairedDifference:
    """Mean over scans of (first minus second), its bootstrap interval and two-sided sign-flip p."""

    mean: float
    interval: tuple[float, float]
    p: float
    first_better: int
    scans: int


def paired_difference(first: Sequence[float], second: Sequence[float], *, seed: int = 0) -> PairedDifference:
    """Compare two lists of errors scan by scan; smaller values are better.

    The null flips the sign of each scan's difference: all combinations up to 14 scans, 9,999 random
    ones beyond (the observed one counted in).

    Raises:
        InputError: lists of different length, or empty.
    """
    if len(first) != len(second) or not first:
        raise InputError(
            "paired scores", got=f"{len(first)} and {len(second)} scans", wanted="the same scans in both"
        )
    difference = np.asarray(first, np.float64) - np.asarray(second, np.float64)
    flipped = np.abs(sign_flips(difference.size, seed, exact_scans=EXACT_PAIRED_SCANS) @ difference)
    return PairedDifference(
        mean=float(difference.mean()),
        interval=bootstrap_interval(difference.tolist(), seed=seed),
        p=float(np.mean(flipped >= abs(difference.sum()) * _ROUNDING)),
        first_better=int((difference < 0).sum()),
        scans=difference.size,
    )
