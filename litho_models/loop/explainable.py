"""How much of a residual could still be learned: a ridge over features of layout and place, out of fold.

It has no name for what it finds and goes into no model. It says whether something is left to be found, and
what a named cause weighs beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from litho_data.foundation.units import NM_PER_UM
from litho_models.fitting.least_squares import gram_inside, orthonormal
from litho_models.fitting.ridge import feature_rows
from litho_models.loop.linear import ALL_FREE
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.layout import richest_features
from litho_models.loop.probes.linear import held_out_ridge
from litho_models.loop.probes.places import map_columns_at
from litho_models.loop.probes.tables import FEWEST_ORDERS, ORDER_STEPS
from litho_models.loop.selection.confirming import SMALLEST_SHARE
from litho_models.loop.study import Study
from litho_models.models.features import Features
from litho_models.scan_terms import Terms
from litho_models.scoring.statistics import interval

# All rows of all scans; with more scans each is thinned.
_KEPT_BYTES, _MOST_ROWS = 512 * 2**20, 360
# Features whose strength may follow the place: height, ∂y and ∂x at 0.3 µm (a gain and a displacement); and
# order or dose: height, |∂y| and |∂x|, surroundings of 1.6 µm.
_PLACED, _VARYING = (18, 19, 20), (18, 21, 22, 7)

# The stage of a loop at which all is in that follows one covariate, by name.
GENERIC_TERMS = "generic terms"


@dataclass(frozen=True)
class Rest:
    """What the learner explains of one residual, out of fold.

    Attributes:
        gains_nm2: (scans,) taken from the squared error of each scan by the ridge that has not seen it.
        squares_nm2: (scans,) the squared error itself; both free of ``k`` terms per scan.
    """

    gains_nm2: np.ndarray
    squares_nm2: np.ndarray
    k: int

    @property
    def mean_nm2(self) -> float:
        return float(self.gains_nm2.mean())

    @property
    def share(self) -> float:
        """Of the squared error."""
        return self.mean_nm2 / max(float(self.squares_nm2.mean()), np.finfo(float).tiny)

    @cached_property
    def ci95_nm2(self) -> tuple[float, float] | None:
        """Interval over scans of the mean gain; None with fewer than six scans."""
        return interval(self.gains_nm2.tolist())

    @property
    def most_nm(self) -> float:
        """The root of the upper end of the interval: what the form of the model may be wrong by, rms."""
        interval_nm2 = self.ci95_nm2
        return float(np.sqrt(max(self.mean_nm2 if interval_nm2 is None else interval_nm2[1], 0.0)))

    @property
    def matters(self) -> bool:
        """Whether something is left that can be learned: more than 1 %, and an interval without zero."""
        return self.share > SMALLEST_SHARE and self.ci95_nm2 is not None and self.ci95_nm2[0] > 0


class Learner:
    """Feature rows of the scans of a study, made once; each residual then costs a few solves.

    Args:
        study: scans and folds.
        predictions: (y, x) µm, one per scan: what a scan's own gain multiplies.
    """

    def __init__(self, study: Study, predictions: Sequence[np.ndarray]):
        self._study = study
        self._predictions = list(predictions)
        model = richest_features(study.scans[0])
        pixels = sum(len(scan.sample) for scan in study.scans)
        self._every = -(-pixels * 4 * _MOST_ROWS // _KEPT_BYTES)
        varied = [of for of in _VARIED if len({of(scan) for scan in study.scans}) >= FEWEST_ORDERS]
        rows = [self._rows(model, scan, varied) for scan in study.scans]
        scale = np.sqrt(np.mean([one.var(axis=1) for one in rows], axis=0))[:, None]
        self._rows_of = [one / np.where(scale > 0, scale, np.float32(1)) for one in rows]
        self._grams = [_gram(one) for one in self._rows_of]
        self._freed: dict[Terms, tuple[list[np.ndarray], np.ndarray]] = {}

    def rest(self, predictions: Sequence[np.ndarray], terms: Terms = ALL_FREE) -> Rest:
        """What the features explain of measured minus predicted, each scan by a ridge that has not seen it.

        Args:
            predictions: held-out predictions (y, x) µm, one per scan; ``terms``: what each scan may add.
        """
        bases, grams = self._without(terms)
        rights, squares = [], []
        for scan, prediction, rows, basis in zip(
            self._study.scans, predictions, self._rows_of, bases, strict=True
        ):
            residual = (scan.height - scan.at_sample(prediction))[:: self._every]
            residual -= basis @ (basis.T @ residual)
            rights.append(rows @ residual)
            squares.append(np.mean(residual**2) * NM_PER_UM**2)
        pixels = np.array([len(basis) for basis in bases])
        found = held_out_ridge(grams, np.stack(rights), pixels, np.eye(grams.shape[1]), self._study.fold_of)
        return Rest(found.gains_nm2, np.array(squares), bases[0].shape[1])

    def _without(self, terms: Terms) -> tuple[list[np.ndarray], np.ndarray]:
        """What each scan may add (n, k), orthonormal, and the features' inner products without it."""
        if terms not in self._freed:
            bases = [
                orthonormal(scan.terms_at_sample(prediction, terms)[:, :: self._every].T)
                for scan, prediction in zip(self._study.scans, self._predictions, strict=True)
            ]
            freed = [
                gram - gram_inside(rows.T, basis)
                for gram, rows, basis in zip(self._grams, self._rows_of, bases, strict=True)
            ]
            self._freed[terms] = bases, np.stack(freed)
        return self._freed[terms]

    def _rows(
        self, model: Features, scan: PreparedScan, varied: Sequence[Callable[[PreparedScan], float]]
    ) -> NDArray[np.float32]:
        """Features of layout and place, and some times order and dose, (m, n)."""
        at = scan.sample[:: self._every]
        of_layout, of_place = feature_rows(model, scan.stored, at), map_columns_at(scan, at)
        varying = np.stack([*of_layout[list(_VARYING)], of_layout[_VARYING[0]] ** 2])
        columns = [of_layout, of_place, *(of_place * of_layout[one] for one in _PLACED)]
        for of in varied:
            value = of(scan)
            columns += [value * varying, *((value > step) * varying for step in ORDER_STEPS)]
        return np.concatenate(columns).astype(np.float32)


def _order(scan: PreparedScan) -> float:
    return scan.context.order


def _dose(scan: PreparedScan) -> float:
    """Less its nominal value, so that it has both signs as the order has."""
    return (scan.stored.dose or 1.0) - 1.0


_VARIED = (_order, _dose)


def _gram(rows: np.ndarray) -> np.ndarray:
    exact = rows.astype(np.float64)
    return exact @ exact.T
