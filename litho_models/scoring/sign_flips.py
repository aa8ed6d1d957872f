"""Tests whose null flips the signs of whole scans: what is estimated from each scan, summed over scans."""

from __future__ import annotations

import numpy as np

SIGN_FLIPS = 9999
EXACT_SCANS = 13


def one_sided_flip_p(values: np.ndarray, seed: int = 0) -> float:
    """Share of sign flips of the scans' values whose sum reaches the observed one."""
    signs = sign_flips(len(values), seed)
    return float(np.mean(signs @ values >= values.sum() * (1 - 1e-12)))


def sign_flips(count: int, seed: int = 0) -> np.ndarray:
    """Signs (draws, count), the observed ones first: all of them up to 13 scans, 10,000 beyond."""
    if count <= EXACT_SCANS:
        return 1.0 - 2.0 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
    drawn = np.random.default_rng(seed).choice([-1.0, 1.0], size=(SIGN_FLIPS, count))
    return np.vstack([np.ones(count), drawn])


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
