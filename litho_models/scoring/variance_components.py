"""Whether estimates vary by print or from scan to scan within a print: one-way analysis of variance."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

PERMUTATIONS = 1999


@dataclass(frozen=True)
class ByPrint:
    """One-way analysis of variance of one estimate per scan, prints as groups.

    Attributes:
        f: mean square between prints over that within, on ``degrees`` of freedom (between, within).
        icc: share of the variance that scans of one print have in common; below 0 it is 0.
        p: share of permutations of the scans, the observed one included, with an ``f`` as large.
    """

    f: float
    degrees: tuple[int, int]
    icc: float
    p: float


def by_print(values: np.ndarray, prints: Sequence[Hashable], seed: int = 0) -> ByPrint | None:
    """Test whether scans of one print are more alike than scans of different prints.

    Args:
        values: (scans,) or (scans, k) estimates; columns count alike, each in units of its spread.
        prints: print of each scan.

    Returns:
        None where one cannot tell: a single print, no print with two scans, or estimates that do not vary.
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
    # Rounding must not put the observed order below itself.
    return ByPrint(f, (between, within), icc, float((ratios >= f * (1 - 1e-12)).mean()))
