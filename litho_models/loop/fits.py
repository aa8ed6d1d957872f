"""Fit a model of the printer to all scans. Then, for each fold, refit the model to the scans of all other
folds and predict the scans of this fold.

Per-scan terms are projected out, so that they do not bias the parameters of the printer.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.sharing.workers import HERE, Workers
from litho_data.store import PrintedScan
from litho_models.effects.chain import Fields
from litho_models.fitting.least_squares import (
    Linearised,
    Rules,
    eliminated_sum,
    fit_least_squares,
    promised_gain,
    solve_damped,
    with_residuals,
)
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.scan_terms import Terms
from litho_models.scan_terms.grouped import Labels, groupings
from litho_models.splits.folds import grouped_folds

# Terms that are free for each scan in a fit. The gain is not free, because long-range effects also change it.
FREE_TERMS: Terms = frozenset({"offset", "bow", "warp"})
# Terms that are free for each scan when errors are compared.
ALL_FREE: Terms = FREE_TERMS | {"gain"}
RULES = Rules("squares", steps=24, kept_above=0.8)


def _silent(message: str) -> None:
    pass


@dataclass(frozen=True)
class Study:
    """Scans with their folds, and the settings by which findings are judged.

    Attributes:
        scans: prepared scans.
        fold_of: (scans,) number of the fold of each scan.
        seed: seed of folds, calibration blocks and permutations.
        workers: pool for independent fits.
        report: function that receives progress messages.
    """

    scans: Sequence[PreparedScan]
    fold_of: np.ndarray
    seed: int = 0
    workers: Workers = HERE
    report: Callable[[str], None] = _silent

    @classmethod
    def dealt(
        cls,
        scans: Sequence[PrintedScan],
        folds: int,
        seed: int = 0,
        workers: Workers = HERE,
        report: Callable[[str], None] = _silent,
    ) -> Study:
        """Divide the scans of a store into at most ``folds`` folds."""
        ids = [scan.id for scan in scans]
        lists = grouped_folds(ids, min(folds, len(ids)), seed)
        fold = {one: number for number, members in enumerate(lists) for one in members}
        return cls(prepare_scans(scans), np.array([fold[one] for one in ids]), seed, workers, report)

    def __getstate__(self) -> dict[str, object]:
        """Drop workers and progress messages, which cannot be sent to another process."""
        return {**self.__dict__, "workers": HERE, "report": _silent}

    @property
    def folds(self) -> list[tuple[list[int], list[int]]]:
        """Return, for each fold, the indices of the scans outside it and of those inside it."""
        own = (self.fold_of == fold for fold in range(int(self.fold_of.max()) + 1))
        return [(np.flatnonzero(~one).tolist(), np.flatnonzero(one).tolist()) for one in own]

    @property
    def stored(self) -> list[PrintedScan]:
        return [scan.stored for scan in self.scans]

    @property
    def windows(self) -> list[PreparedScan]:
        """Return the part of each scan that fits and screening use."""
        return [scan.window for scan in self.scans]

    @property
    def tip_radius_um(self) -> float | None:
        """Return the tip radius, or an upper bound for it, from the first scan that states one; None if no
        scan does.
        """
        known = (scan.stored.tip_radius_um for scan in self.scans)
        return next((radius for radius in known if radius is not None), None)

    @property
    def of_films(self) -> bool:
        """Return whether the scans are micrographs of a film.

        The edges of such scans are scored, and their heights do not drift.
        """
        return self.scans[0].stored.seen_by == "sem"

    @cached_property
    def groups(self) -> dict[str, Labels]:
        """Return the label of each scan in every grouping."""
        return groupings(self.stored)


@dataclass(frozen=True, eq=False)
class State:
    """A model fitted to the scans of a study.

    Attributes:
        twin: the model fitted to all scans.
        per_fold: for each fold, the model fitted without the scans of this fold.
        linear: residual, derivatives and free terms of each window at ``twin``.
        held_out_um: residual (n,) of each window, for the model that was fitted without the fold of the
            window.
        freed_um: ``held_out_um`` after the free terms of each scan are projected out.
    """

    study: Study
    twin: Twin
    per_fold: list[Twin]
    linear: list[Linearised]
    held_out_um: list[np.ndarray]
    freed_um: list[np.ndarray]
    # Cached models without one effect, because several steps need the same model.
    _without: dict[str, State] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def freed_nm2(self) -> np.ndarray:
        """Return the mean square of ``freed_um`` for each scan, (scans,), nm²."""
        return np.array([NM_PER_UM**2 * np.mean(left**2) for left in self.freed_um])

    @property
    def mse_nm2(self) -> float:
        return float(self.freed_nm2.mean())

    def __getstate__(self) -> dict[str, object]:
        """Leave the scans out when a state is sent to another process."""
        return {**self.__dict__, "study": None}

    def without(self, name: str) -> State:
        """Remove one effect and refit the model from its current values."""
        if name not in self._without:
            self._without[name] = fit_state(self.twin.without(name), self.study, from_here=True)
        return self._without[name]

    def maps_um(self, scans: Sequence[PreparedScan]) -> list[np.ndarray]:
        """Predict the print (y, x) of each scan, or of its window, by the model fitted without the fold of
        the scan.
        """
        folds = zip(self.study.fold_of, scans, strict=True)
        return [self.per_fold[fold].height(scan) for fold, scan in folds]


class TwinProblem:
    """The least-squares problem of a model on windows of scans; derivatives are difference quotients."""

    def __init__(self, twin: Twin, windows: Sequence[PreparedScan]):
        self._twin = twin
        self._windows = windows

    def linearise(self, vector: np.ndarray) -> list[Linearised]:
        """Return the residuals, derivatives and free terms of all windows."""
        here = self._twin.at(vector)
        steps = here.steps()
        moved = [here.at(vector + one) for one in np.diag(steps)]
        return [self._of_window(here, moved, steps, window) for window in self._windows]

    def _of_window(
        self, twin: Twin, moved: Sequence[Twin], steps: np.ndarray, window: PreparedScan
    ) -> Linearised:
        fields: Fields = {}
        prediction = twin.height(window, known=fields)
        value = window.at_sample(prediction)
        rows = np.zeros((len(steps), len(window.sample)))
        for at, (other, slot) in enumerate(zip(moved, [None] * twin.own + [*twin.slots], strict=True)):
            if slot is None or twin.is_of(slot, window):
                # Only the changed effect and the effects after it are computed again.
                there = other.height(window, known=ChainMap({}, fields))
                rows[at] = (window.at_sample(there) - value) / steps[at]
        return Linearised(window.height - value, rows, window.free_basis(prediction, FREE_TERMS).T)

    def residuals(self, vector: np.ndarray) -> list[np.ndarray]:
        """Return the measured minus predicted heights of all windows, µm."""
        twin = self._twin.at(vector)
        return [window.height - window.at_sample(twin.height(window)) for window in self._windows]

    def room(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest allowed steps. These steps keep the effects within their ranges and
        change the base parameters by small amounts.
        """
        return self._twin.at(vector).room()


def fit_state(twin: Twin, study: Study, *, from_here: bool = False) -> State:
    """Fit a model to all windows of a study, then once per fold without the windows of that fold.

    Args:
        from_here: start at the current values. Otherwise, try these values and the base's default values,
            and use the start that leads to the smaller error.
    """
    windows = study.windows
    start = twin.vector if from_here else _best_start(twin, windows)
    fitted = fit_least_squares(TwinProblem(twin, windows), start, RULES)
    common = twin.at(fitted.vector)
    free = common.free()
    linear = [replace(part, jacobian=part.jacobian * free[:, None]) for part in fitted.linear]
    per_fold = [
        _without(common, fold, [fitted.linear[i] for i in own], [windows[i] for i in own])
        for fold, (own, _) in enumerate(study.folds)
    ]
    maps = [per_fold[fold].height(one) for fold, one in zip(study.fold_of, windows, strict=True)]
    held_out = [one.height - one.at_sample(own) for one, own in zip(windows, maps, strict=True)]
    freed = [
        without_terms(left[:, None], window, own)[:, 0]
        for left, window, own in zip(held_out, windows, maps, strict=True)
    ]
    return State(study, common, per_fold, linear, held_out, freed)


def _best_start(twin: Twin, windows: Sequence[PreparedScan]) -> np.ndarray:
    """Return the better start of a fit: the current values or the base's default values.

    The better start is the one from which a fit to some of the scans reaches the smaller error.

    A base that was fitted without an effect has absorbed part of it. When the effect is added, a fit from
    the current values may therefore be stuck in a local optimum.
    """
    unfitted = twin.with_base_unfitted().vector
    if not twin.slots or np.array_equal(unfitted, twin.vector):
        return twin.vector
    # Every third scan is enough to come close to the optimum.
    some = TwinProblem(twin, windows[::3] if len(windows) > 6 else windows)
    fits = [fit_least_squares(some, start, RULES) for start in (twin.vector, unfitted)]
    return min(fits, key=lambda fit: eliminated_sum(fit.linear, RULES.term_weight)[2]).vector


def without_terms(
    columns: np.ndarray, window: PreparedScan, prediction_um: np.ndarray, terms: Terms = ALL_FREE
) -> np.ndarray:
    """Project the free terms of a scan out of columns (n, m) at its sampled pixels.

    The terms are computed from the prediction (y, x), µm, of the scan.
    """
    basis = window.free_basis(prediction_um, terms)
    return columns - basis @ (basis.T @ columns)


def _without(common: Twin, fold: int, linear: Sequence[Linearised], windows: Sequence[PreparedScan]) -> Twin:
    """Fit the model to some of the windows, using the derivatives of the common fit.

    The fit starts from the common fit, which used all windows. It must therefore be iterated to convergence.
    """
    twin = common.of_fold(fold)
    problem, vector = TwinProblem(twin, windows), twin.vector
    if not len(vector):
        return twin
    if twin is not common:
        # The common fit used every fold, so its predictions are not held out.
        linear = with_residuals(linear, problem.residuals(vector))
    normal, right, total = eliminated_sum(linear, RULES.term_weight)
    for _ in range(6):
        step = solve_damped(normal, right, 1e-6, twin.at(vector).room())
        trial = vector + step
        # For such a small step the linear model is exact enough.
        if promised_gain(normal, right, step) <= 1e-4 * total:
            vector = trial
            break
        left = with_residuals(linear, problem.residuals(trial))
        _, right, squares = eliminated_sum(left, RULES.term_weight)
        if squares > total:
            break
        vector, total = trial, squares
    return twin.at(vector).known_from(windows)
