"""Estimate how much of a residual could still be learned, by a cross-validated ridge regression.

The ridge uses features of layout and position. It names no cause and is part of no model. It shows whether
the residual has structure, and how large this structure is compared with the gain of a named cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from litho_data.foundation.units import NM_PER_UM
from litho_models.fitting.least_squares import gram_inside, orthonormal
from litho_models.fitting.ridge import feature_rows
from litho_models.loop.fits import ALL_FREE, Study
from litho_models.loop.judging import SMALLEST_SHARE
from litho_models.loop.prepared import PreparedScan, sample_border_px
from litho_models.models.features import Features, FeaturesConfig, RandomFeaturesConfig
from litho_models.scan_terms.grouped import ALL, Block, Products
from litho_models.scoring.statistics import interval

# Memory limit for the feature rows; with more scans, fewer pixels of each scan are used.
_KEPT_BYTES = 512 * 2**20
# Features whose strength may depend on order or dose: height, |∂y| and |∂x| at 0.3 µm, and surroundings of
# 1.6 µm.
_VARYING = (18, 21, 22, 7)


@dataclass(frozen=True)
class Rest:
    """The part of a residual that the ridge explains on held-out scans.

    Attributes:
        gains_nm2: (scans,) squared error that the ridge removes from each held-out scan.
        squares_nm2: (scans,) squared error without the ridge. The free terms of the scans are excluded from
            both arrays.
    """

    gains_nm2: np.ndarray
    squares_nm2: np.ndarray

    @property
    def mean_nm2(self) -> float:
        return float(self.gains_nm2.mean())

    @property
    def share(self) -> float:
        """Return the explained share of the squared error."""
        return self.mean_nm2 / max(float(self.squares_nm2.mean()), np.finfo(float).tiny)

    @cached_property
    def ci95_nm2(self) -> tuple[float, float] | None:
        """Return the confidence interval of the mean gain over scans; None for fewer than six scans."""
        return interval(self.gains_nm2.tolist())

    @property
    def most_nm(self) -> float:
        """Return an upper bound on the rms error caused by the form of the model: the square root of the
        upper end of ``ci95_nm2``.
        """
        _, most_nm2 = self.ci95_nm2 or (None, self.mean_nm2)
        return float(np.sqrt(max(most_nm2, 0.0)))

    @property
    def matters(self) -> bool:
        """Return whether the residual can be learned: the share exceeds 1 %, and the interval is above
        zero.
        """
        low, _ = self.ci95_nm2 or (0.0, None)
        return self.share > SMALLEST_SHARE and low > 0


class Learner:
    """The features of a study's scans, computed once for any number of residuals.

    Args:
        study: scans and folds.
        predictions: (y, x) µm, one per scan; the free gain of a scan multiplies its prediction.
    """

    def __init__(self, study: Study, predictions: Sequence[np.ndarray]):
        self._study = study
        model = _all_features(study.scans[0])
        pixels = sum(len(scan.sample) for scan in study.scans)
        self._every = -(-pixels * 4 * 360 // _KEPT_BYTES)
        # These are the writing order and the deviation of the dose from nominal. A dependence on either can
        # be learned only if the scans have at least three different values of it.
        facts = np.array([(s.context.order, (s.stored.dose or 1.0) - 1.0) for s in study.scans])
        varied = [own for own in facts.T.tolist() if len(set(own)) >= 3]
        rows = [self._rows(model, scan, [own[at] for own in varied]) for at, scan in enumerate(study.scans)]
        scale = np.sqrt(np.mean([one.var(axis=1) for one in rows], axis=0))[:, None]
        self._rows_of = [one / np.where(scale > 0, scale, np.float32(1)) for one in rows]
        self._bases = [
            orthonormal(scan.terms_at_sample(own, ALL_FREE)[:, :: self._every].T)
            for scan, own in zip(study.scans, predictions, strict=True)
        ]
        pairs = zip(self._rows_of, self._bases, strict=True)
        self._grams = np.stack(
            [(_gram(own) - gram_inside(own.T, basis)) / len(basis) for own, basis in pairs]
        )

    def rest(self, predictions: Sequence[np.ndarray]) -> Rest:
        """Explain the residual of each scan (measured minus predicted heights) by a ridge fitted to scans of
        other folds.

        Args:
            predictions: held-out predictions (y, x) µm, one per scan.
        """
        scans, count = self._study.scans, self._grams.shape[1]
        grams = np.zeros((len(scans), 1 + count, 1 + count))
        grams[:, 1:, 1:] = self._grams
        parts = zip(scans, predictions, self._rows_of, self._bases, grams, strict=True)
        for scan, own, rows, basis, gram in parts:
            residual = (scan.height - scan.at_sample(own))[:: self._every]
            residual -= basis @ (basis.T @ residual)
            gram[0, 0] = np.mean(residual**2)
            gram[0, 1:] = gram[1:, 0] = rows @ residual / len(residual)
        left = _held_out(grams, self._study.fold_of) * NM_PER_UM**2
        squares = grams[:, 0, 0] * NM_PER_UM**2
        return Rest(squares - left, squares)

    def _rows(self, model: Features, scan: PreparedScan, varied: Sequence[float]) -> NDArray[np.float32]:
        """Return the features of layout and position, and products of some features with order and dose, (m,
        n).
        """
        at = scan.sample[:: self._every]
        of_layout, of_place = feature_rows(model, scan.stored, at), _place_columns(scan, at)
        varying = np.stack([*of_layout[list(_VARYING)], of_layout[_VARYING[0]] ** 2])
        # Height, ∂y and ∂x represent a gain and a displacement whose strength may depend on position.
        placed = (18, 19, 20)
        columns = [of_layout, of_place, *(of_place * of_layout[one] for one in placed)]
        for value in varied:
            columns += [value * varying, *((value > step) * varying for step in (-0.25, 0.0, 0.25))]
        return np.concatenate(columns).astype(np.float32)


def _gram(rows: np.ndarray) -> np.ndarray:
    exact = rows.astype(np.float64)
    return exact @ exact.T


def _held_out(grams: np.ndarray, fold_of: np.ndarray) -> np.ndarray:
    """Return the mean squared residual (scans,). The ridge for each scan is fitted and regularised without
    the fold of the scan.
    """
    left, products = np.empty(len(grams)), Products.ungrouped(grams)
    columns = tuple(range(1, grams.shape[1]))
    # Strength of regularisation, in scans.
    blocks = [Block(columns, ALL, shrinking) for shrinking in (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)]
    for fold in np.unique(fold_of):
        own, rest = np.flatnonzero(fold_of == fold), np.flatnonzero(fold_of != fold)
        inner, inner_of = Products.ungrouped(grams[rest]), fold_of[rest]
        if len(set(inner_of)) == 1:
            inner_of = rest
        # With a single scan, no strength can be cross-validated, so the strongest regularisation is used.
        block = blocks[-1]
        if len(rest) > 1:
            block = min(blocks, key=lambda one: float(inner.held_out([one], inner_of).sum()))
        left[own] = products.squares([block], products.strengths([block], rest), own)
    return left


def _all_features(scan: PreparedScan) -> Features:
    """Return the layout features of the zoo's models for scans like this one, except the random features."""
    first = scan.stored
    config = RandomFeaturesConfig.of_variant(
        pitch_um=first.pitch_um, level_height_um=first.level_height_um, levels=first.levels
    )
    return Features(FeaturesConfig(**config.model_dump(include=set(FeaturesConfig.model_fields))))


def _place_columns(scan: PreparedScan, at: np.ndarray) -> np.ndarray:
    """Return the products of splines along y and x at flat indices of a scan, shape (25, n)."""
    (ny, nx), (y, x) = scan.stored.shape, np.divmod(at, scan.stored.shape[1])
    return (_splines(ny)[:, None, y] * _splines(nx)[None, :, x]).reshape(-1, len(at))


def _splines(size: int) -> np.ndarray:
    """Return the cubic splines (5, size) over the sampled part of an axis; they add up to 1.

    They are constant outside the sampled part, where no measured pixel would determine them.
    """
    first = sample_border_px(size)
    position = np.interp(np.arange(size), [first, size - 1 - first], [-1.0, 1.0])
    knots = np.concatenate([[-1.0] * 3, np.linspace(-1, 1, 3), [1.0] * 3])
    return BSpline.design_matrix(position, knots, 3).toarray().T
