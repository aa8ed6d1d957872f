"""Probes that are linear in a few columns: ridge fits from inner products, judged on scans held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.fitting.least_squares import orthonormal
from litho_models.loop.linear import ALL_FREE
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.probe import Estimate, sums_by_fold
from litho_models.scan_terms import Terms

# Relative to the mean information per column; the grid is wide, its choice is made on training scans.
RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
# A column that carries less than this part of the strongest one's information is not estimated.
_IDLE = 1e-6

Summary = Callable[[np.ndarray], dict[str, tuple[float, str]]]
ColumnsOf = Callable[[PreparedScan, np.ndarray], np.ndarray]
MapOf = Callable[[np.ndarray, PreparedScan, np.ndarray], np.ndarray]
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
        rows_of: (scan, prediction (y, x) µm) -> columns at the sampled pixels (m, n).
        map_of: (coefficients (m,), scan, prediction (y, x) µm) -> height to add (y, x), µm.
        penalty: (m, m), what a ridge fit keeps small.
        shuffle: (generator, m) -> order of the columns of one scan under the probe's control; None turns the
            residual of a scan upside down or not.
        summary: coefficients -> numbers for people, name to (value, unit).
        grams, rights: (scans, m, m) and (scans, m), freed of per-scan terms, µm².
        pixels: (scans,).
    """

    name: str
    rows_of: ColumnsOf
    map_of: MapOf
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

    def controls(self, fold_of: np.ndarray, random: np.random.Generator, count: int) -> np.ndarray:
        """Mean held-out gains (count,), nm², after the columns or the sign of every scan were shuffled."""
        if self.shuffle is None:
            signs = random.choice([-1.0, 1.0], size=(count, *self.pixels.shape, 1))
            per_scan = _without_each_fold(self.grams, signs * self.rights, self.penalty, fold_of)[1]
            return (per_scan / self.pixels * NM_PER_UM**2).mean(axis=-1)
        return np.array([self._shuffled(self.shuffle, fold_of, random) for _ in range(count)])

    def _shuffled(self, shuffle: Shuffle, fold_of: np.ndarray, random: np.random.Generator) -> float:
        grams, rights = np.empty_like(self.grams), np.empty_like(self.rights)
        for scan in range(len(grams)):
            order = shuffle(random, len(self.penalty))
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
        return self.map_of(parameters, scan, prediction).astype(np.float32)

    def at_samples(self, parameters: np.ndarray, scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        """Heights (p, n) at the sampled pixels, µm, of parameters (p, m)."""
        return parameters @ self.rows_of(scan, prediction)


def linear_probe(
    name: str,
    columns_of: ColumnsOf,
    penalty: np.ndarray,
    shuffle: Shuffle | None,
    summary: Summary,
    left: Left,
) -> LinearProbe:
    """A probe whose columns are maps: ``columns_of``: (scan, prediction (y, x) µm) -> maps (m, y, x)."""
    rows_of, map_of = partial(_sampled, columns_of=columns_of), partial(_mixed, columns_of=columns_of)
    return probe_of_rows(name, rows_of, map_of, penalty, shuffle, summary, left)


def probe_of_rows(
    name: str,
    rows_of: ColumnsOf,
    map_of: MapOf,
    penalty: np.ndarray,
    shuffle: Shuffle | None,
    summary: Summary,
    left: Left,
) -> LinearProbe:
    """Measure a probe's inner products with the residual on the sampled pixels.

    Args:
        rows_of, map_of: as of the probe.
    """
    grams, rights = [], []
    for scan, prediction, use in zip(*left, strict=True):
        residual = scan.height - scan.at_sample(prediction)
        columns = np.vstack([rows_of(scan, prediction), residual])[:, use].T
        basis = orthonormal(scan.terms_at_sample(prediction, ALL_FREE)[:, use].T)
        columns -= basis @ (basis.T @ columns)
        products = columns.T @ columns
        grams.append(products[:-1, :-1])
        rights.append(products[:-1, -1])
    pixels = np.array([use.sum() for use in left.kept])
    inner_products = np.stack(grams), np.stack(rights), pixels
    return LinearProbe(name, rows_of, map_of, penalty, shuffle, summary, *inner_products)


def _sampled(scan: PreparedScan, prediction: np.ndarray, columns_of: ColumnsOf) -> np.ndarray:
    return np.stack([scan.at_sample(column) for column in columns_of(scan, prediction)])


def _mixed(
    coefficients: np.ndarray, scan: PreparedScan, prediction: np.ndarray, columns_of: ColumnsOf
) -> np.ndarray:
    return np.tensordot(coefficients, columns_of(scan, prediction), axes=1)


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
    per_fold, gains = _without_each_fold(grams, rights, penalty, fold_of)
    fold_grams, fold_rights = sums_by_fold(grams, fold_of), sums_by_fold(rights, fold_of)
    return Estimate(
        common=_best_ridge(fold_grams, fold_rights, penalty),
        per_fold=per_fold,
        gains_nm2=gains / pixels * NM_PER_UM**2,
    )


def _without_each_fold(
    grams: np.ndarray, rights: np.ndarray, penalty: np.ndarray, fold_of: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (folds, ..., m) without each fold, their gains (..., scans); rights: (..., scans, m)."""
    fold_grams, fold_rights = sums_by_fold(grams, fold_of), sums_by_fold(rights, fold_of, axis=-2)
    folds = np.arange(len(fold_grams))
    per_fold = np.stack(
        [_best_ridge(fold_grams[folds != f], fold_rights[..., folds != f, :], penalty) for f in folds]
    )
    gains = [_gain(gram, rights[..., i, :], per_fold[fold_of[i]]) for i, gram in enumerate(grams)]
    return per_fold, np.stack(gains, axis=-1)


def _best_ridge(grams: np.ndarray, rights: np.ndarray, penalty: np.ndarray) -> np.ndarray:
    """The ridges (..., m) whose fits without a fold do best on that fold, then fitted on all of them."""
    gram, right = grams.sum(axis=0), rights.sum(axis=-2)
    ridges = RIDGES if len(grams) > 1 else RIDGES[:1]
    totals = np.zeros((len(ridges), *right.shape[:-1]))
    for fold, own in enumerate(grams):
        own_right = rights[..., fold, :]
        totals += _gain(own, own_right, _ridge(gram - own, right - own_right, penalty, ridges))
    best = np.argmax(totals, axis=0)
    return np.take_along_axis(_ridge(gram, right, penalty, ridges), best[None, ..., None], axis=0)[0]


def _ridge(gram: np.ndarray, right: np.ndarray, penalty: np.ndarray, ridges: Sequence[float]) -> np.ndarray:
    """Coefficients (ridges, ..., m) for right-hand sides (..., m)."""
    information = np.diag(gram)
    known = information > _IDLE * max(information.max(), np.finfo(float).tiny)
    coefficients = np.zeros((len(ridges), *right.shape))
    if not known.any():
        return coefficients
    own = np.ix_(known, known)
    scale = information[known].mean() / max(np.diag(penalty)[known].mean(), np.finfo(float).tiny)
    # Every penalty has some weight on the size, so that the system has one solution.
    systems = gram[own] + scale * np.array(ridges)[:, None, None] * penalty[own]
    wanted = right[..., known].reshape(-1, known.sum())
    coefficients[..., known] = (
        np.linalg.solve(systems, wanted.T).swapaxes(1, 2).reshape(len(ridges), *right.shape[:-1], -1)
    )
    return coefficients


def _gain(gram: np.ndarray, right: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Gains (...) of coefficients (..., m)."""
    return (coefficients * (2 * right - coefficients @ gram)).sum(axis=-1)
