"""Linear algebra of the loop: what is left of changes once single scans may add what they like."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_models.fitting.least_squares import orthonormal
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms import Terms

# What a score test or a comparison of shapes leaves to the single scans.
ALL_FREE: Terms = frozenset({"offset", "bow", "gain", "warp"})


def free_basis(scan: PreparedScan, prediction: np.ndarray, terms: Terms = ALL_FREE) -> np.ndarray:
    """Orthonormal basis (n, k) of what a scan may add at its sampled pixels.

    Args:
        scan: the scan; ``prediction``: predicted height (y, x), µm; ``terms``: which terms it has.
    """
    return orthonormal(scan.terms_at_sample(prediction, terms).T)


def without_scan_terms(
    columns: np.ndarray, scan: PreparedScan, prediction: np.ndarray, terms: Terms = ALL_FREE
) -> np.ndarray:
    """Columns (n,) or (n, m) at the sampled pixels, freed of what a single scan may add."""
    basis = free_basis(scan, prediction, terms)
    return columns - basis @ (basis.T @ columns)


def pooled_cosine(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> float:
    """Cosine between two sets of vectors, their inner products summed over the sets."""
    inner, own, other = (
        sum(float(x @ y) for x, y in zip(*pair, strict=True)) for pair in ((a, b), (a, a), (b, b))
    )
    return inner / max(np.sqrt(own * other), np.finfo(float).tiny)
