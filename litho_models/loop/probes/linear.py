"""Probes that are linear in a few columns: ridge fits from inner products, judged on scans held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.fitting.least_squares import orthonormal
from litho_models.loop.linear import ALL_FREE
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.probe import Estimate
from litho_models.scan_terms import Terms

# Relative to the mean information per column; the grid is wide, its choice is made on training scans.
RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
# A column that carries less than this part of the strongest one's information is not estimated.
_IDLE = 1e-6

Summary = Callable[[np.ndarray], dict[str, tuple[float, str]]]
ColumnsOf = Callable[[PreparedScan, np.ndarray], np.ndarray]
Shuffle = Callable[[np.random.Generator, int], np.ndarray]


class Left(NamedTuple):
    """What is left of the scans: their held-out predictions (y, x) µm, and the sampled pixels in no defect.

    ``kept``: bool (n,) per scan.
    """

    scans: Sequence[PreparedScan]
    predictions: Sequence[np.ndarray]
    kept: Sequence[np.ndarray]


@dataclass(frozen=True)
class LinearProbe:
    """Residual = columns · coefficients, the same coefficients for all scans.

    Attributes:
        columns_of: (scan, prediction (y, x) µm) -> maps (m, y, x).
        penalty: (m, m), what a ridge fit keeps small.
        shuffle: (generator, m) -> order of the columns of one scan under the probe's control; None turns the
            residual of a scan upside down or not.
        summary: coefficients -> numbers for people, name to (value, unit).
        grams, rights: (scans, m, m) and (scans, m), freed of per-scan terms, µm².
        pixels: (scans,).
    """

    name: str
    columns_of: ColumnsOf
    penalty: np.ndarray
    shuffle: Shuffle | None
    summary: Summary
    grams: np.ndarray
    rights: np.ndarray
    pixels: np.ndarray

    @property
    def free(self) -> Terms:
        return ALL_FREE

    def held_out(self, fold_of: np.ndarray) -> Estimate:
        """Coefficients without each fold, and the gain of each scan by those that have not seen it."""
        return held_out_ridge(self.grams, self.rights, self.pixels, self.penalty, fold_of)

    def control(self, fold_of: np.ndarray, random: np.random.Generator) -> float:
        """Mean held-out gain, nm², after the columns or the sign of every scan were shuffled on their own."""
        if self.shuffle is None:
            signs = random.choice([-1.0, 1.0], size=(len(self.rights), 1))
            mixed = signs * self.rights
            return held_out_ridge(self.grams, mixed, self.pixels, self.penalty, fold_of).mean_gain_nm2
        grams, rights = np.empty_like(self.grams), np.empty_like(self.rights)
        for scan in range(len(grams)):
            order = self.shuffle(random, len(self.penalty))
            grams[scan], rights[scan] = self.grams[scan][np.ix_(order, order)], self.rights[scan][order]
        return held_out_ridge(grams, rights, self.pixels, self.penalty, fold_of).mean_gain_nm2

    def agreement(self) -> float:
        """Correlation of the corrections that two disjoint halves of the scans ask for."""
        halves = [np.arange(start, len(self.grams), 2) for start in (0, 1)]
        first, second = (
            _ridge(self.grams[h].sum(0), self.rights[h].sum(0), self.penalty, (1e-2,))[0] for h in halves
        )
        pooled = self.grams.sum(axis=0)
        sizes = np.sqrt(max(first @ pooled @ first, 0.0) * max(second @ pooled @ second, 0.0))
        return float(first @ pooled @ second / max(sizes, np.finfo(float).tiny))

    def correction(self, parameters: np.ndarray, scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        """Height to add (y, x), µm."""
        return np.tensordot(parameters, self.columns_of(scan, prediction), axes=1).astype(np.float32)


def linear_probe(
    name: str,
    columns_of: ColumnsOf,
    penalty: np.ndarray,
    shuffle: Shuffle | None,
    summary: Summary,
    left: Left,
) -> LinearProbe:
    """Measure a probe's inner products with the residual on the sampled pixels."""
    grams, rights = [], []
    for scan, prediction, use in zip(*left, strict=True):
        maps = columns_of(scan, prediction)
        columns = np.stack([scan.at_sample(m) for m in maps] + [scan.height - scan.at_sample(prediction)])
        columns = columns[:, use].T
        basis = orthonormal(scan.terms_at_sample(prediction, ALL_FREE)[:, use].T)
        columns -= basis @ (basis.T @ columns)
        products = columns.T @ columns
        grams.append(products[:-1, :-1])
        rights.append(products[:-1, -1])
    pixels = np.array([use.sum() for use in left.kept])
    return LinearProbe(name, columns_of, penalty, shuffle, summary, np.stack(grams), np.stack(rights), pixels)


def second_differences(count: int) -> np.ndarray:
    """Penalty (count, count) on the bends of a sequence."""
    operator = np.diff(np.eye(count), n=2, axis=0)
    return operator.T @ operator


def held_out_ridge(
    grams: np.ndarray, rights: np.ndarray, pixels: np.ndarray, penalty: np.ndarray, fold_of: np.ndarray
) -> Estimate:
    """Ridge fits without each fold and their gains on the scans of that fold.

    Args:
        grams, rights, pixels: (scans, m, m) and (scans, m), µm², and (scans,).
        penalty: (m, m), what is kept small; how much is chosen inside the training folds.
        fold_of: (scans,).
    """
    folds = np.arange(int(fold_of.max()) + 1)
    fold_grams, fold_rights = (
        np.stack([part[fold_of == fold].sum(axis=0) for fold in folds]) for part in (grams, rights)
    )
    per_fold = [_best_ridge(fold_grams[folds != f], fold_rights[folds != f], penalty) for f in folds]
    gains = np.array(
        [_gain(gram, right, per_fold[f]) for gram, right, f in zip(grams, rights, fold_of, strict=True)]
    )
    return Estimate(
        common=_best_ridge(fold_grams, fold_rights, penalty),
        per_fold=np.stack(per_fold),
        gains_nm2=gains / pixels * NM_PER_UM**2,
    )


def _best_ridge(grams: np.ndarray, rights: np.ndarray, penalty: np.ndarray) -> np.ndarray:
    """The ridge whose fits without a fold do best on that fold, then fitted on all of them."""
    gram, right = grams.sum(axis=0), rights.sum(axis=0)
    others = [(gram - own_gram, right - own_right) for own_gram, own_right in zip(grams, rights, strict=True)]
    ridges = RIDGES if len(grams) > 1 else RIDGES[:1]
    totals = sum(
        np.array([_gain(own_gram, own_right, one) for one in _ridge(*kept, penalty, ridges)])
        for own_gram, own_right, kept in zip(grams, rights, others, strict=True)
    )
    return _ridge(gram, right, penalty, (ridges[int(np.argmax(totals))],))[0]


def _ridge(gram: np.ndarray, right: np.ndarray, penalty: np.ndarray, ridges: Sequence[float]) -> np.ndarray:
    """Coefficients (ridges, m)."""
    information = np.diag(gram)
    known = information > _IDLE * max(information.max(), np.finfo(float).tiny)
    own = np.ix_(known, known)
    scale = information[known].mean() / max(np.diag(penalty)[known].mean(), np.finfo(float).tiny)
    # Every penalty has some weight on the size, so that the system has one solution.
    coefficients = np.zeros((len(ridges), len(right)))
    systems = gram[own] + scale * np.array(ridges)[:, None, None] * penalty[own]
    coefficients[:, known] = np.linalg.solve(systems, right[known][:, None])[..., 0]
    return coefficients


def _gain(gram: np.ndarray, right: np.ndarray, coefficients: np.ndarray) -> float:
    return float(2 * coefficients @ right - coefficients @ gram @ coefficients)
