"""Fit a model of the printer to all scans. Then, for each fold, refit the model to the scans of all other
folds, and predict the scans of this fold.

Terms that differ from scan to scan, such as datum and tilt, are projected out of the residuals and
derivatives, so that they do not bias the parameters of the printer.
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
from litho_data.store.lock_box import field_of
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
from litho_models.loop.prepared import FREE_TERMS, PreparedScan, prepare_scans
from litho_models.scan_terms.grouped import Labels, groupings
from litho_models.splits.folds import grouped_folds

RULES = Rules("squares", steps=24, kept_above=0.8)


def _silent(message: str) -> None:
    pass


@dataclass(frozen=True)
class Study:
    """Scans with their folds, and the settings for judging findings.

    Attributes:
        scans: the prepared scans.
        fold_of: number of the fold of each scan, of shape (scans,).
        seed: seed of the folds, the calibration blocks and the permutations.
        workers: pool of processes for independent fits.
        report: function that receives the progress messages.
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
        """Prepare scans and divide them into at most ``folds`` folds."""
        ids = [scan.id for scan in scans]
        lists = grouped_folds(ids, [field_of(scan) for scan in scans], folds, seed)
        fold = {one: number for number, members in enumerate(lists) for one in members}
        return cls(prepare_scans(scans), np.array([fold[one] for one in ids]), seed, workers, report)

    def __getstate__(self) -> dict[str, object]:
        """Leave out the workers and the function for progress messages, which cannot be sent to
        another process.
        """
        return {**self.__dict__, "workers": HERE, "report": _silent}

    @property
    def folds(self) -> list[tuple[list[int], list[int]]]:
        """Return two lists of scan indices per fold: the scans outside the fold, and the scans inside it."""
        own = (self.fold_of == fold for fold in range(int(self.fold_of.max()) + 1))
        return [(np.flatnonzero(~one).tolist(), np.flatnonzero(one).tolist()) for one in own]

    @property
    def stored(self) -> list[PrintedScan]:
        return [scan.stored for scan in self.scans]

    @property
    def windows(self) -> list[PreparedScan]:
        """Return the window of each scan, i.e. the part of the scan that is used for fits and screening."""
        return [scan.window for scan in self.scans]

    @property
    def tip_radius_um(self) -> float | None:
        """Return the radius of the tip of the microscope, or an upper bound for this radius, µm. It is taken
        from the first scan that states it. Return None if no scan states it.
        """
        known = (scan.stored.tip_radius_um for scan in self.scans)
        return next((radius for radius in known if radius is not None), None)

    @property
    def of_films(self) -> bool:
        """Return whether the scans are electron micrographs of a film.

        For films, the positions of edges are scored instead of heights, and single scans have no height
        errors such as drift.
        """
        return self.scans[0].stored.seen_by == "sem"

    @cached_property
    def groups(self) -> dict[str, Labels]:
        """Return, for each grouping of the scans, the label of the group to which each scan belongs. The
        result is keyed by the name of the grouping.
        """
        return groupings(self.stored)


@dataclass(frozen=True, eq=False)
class State:
    """A model fitted to the scans of a study.

    Attributes:
        twin: the model fitted to all scans.
        per_fold: for each fold, the model fitted without the scans of this fold.
        linear: for each window (the part of a scan that is used for fits), the least-squares problem
            linearised at the parameters of ``twin``. It consists of the residual, the derivatives and the
            free terms.
        held_out_um: residual of each window at its n sampled pixels, µm, of shape (n,). The prediction is
            made by the model that was fitted without the fold of this window.
        freed_um: ``held_out_um`` after the free terms of each scan are projected out.
    """

    study: Study
    twin: Twin
    per_fold: list[Twin]
    linear: list[Linearised]
    held_out_um: list[np.ndarray]
    freed_um: list[np.ndarray]
    # Cache of models without one of the effects, keyed by the name of this effect. Several steps of the loop
    # need the same model.
    _without: dict[str, State] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def freed_nm2(self) -> np.ndarray:
        """Return the mean square of ``freed_um`` for each scan, nm², of shape (scans,)."""
        return np.array([NM_PER_UM**2 * np.mean(left**2) for left in self.freed_um])

    @property
    def mse_nm2(self) -> float:
        return float(self.freed_nm2.mean())

    def __getstate__(self) -> dict[str, object]:
        """Leave out the study with its scans when a state is sent to another process."""
        return {**self.__dict__, "study": None}

    def without(self, name: str) -> State:
        """Return the model without the named effect, refitted from the current parameters."""
        if name not in self._without:
            self._without[name] = fit_state(self.twin.without(name), self.study, from_here=True)
        return self._without[name]

    def maps_um(self, scans: Sequence[PreparedScan]) -> list[np.ndarray]:
        """Predict the height of the print in each scan (or window), µm, of shape (ny, nx). Each prediction is
        made by the model that was fitted without the fold of this scan.
        """
        folds = zip(self.study.fold_of, scans, strict=True)
        return [self.per_fold[fold].height(scan) for fold, scan in folds]


class TwinProblem:
    """The least-squares problem of fitting a model to windows of scans. Derivatives are computed as
    difference quotients.
    """

    def __init__(self, twin: Twin, windows: Sequence[PreparedScan]):
        self._twin = twin
        self._windows = windows

    def linearise(self, vector: np.ndarray) -> list[Linearised]:
        """Return the residuals, the derivatives and the free terms of all windows at the given parameters."""
        here = self._twin.at(vector)
        steps = here.steps()
        moved = [here.at(vector + one) for one in np.diag(steps)]
        linear = []
        for window in self._windows:
            fields: Fields = {}
            prediction = here.height(window, known=fields)
            value = window.at_sample(prediction)
            rows = np.zeros((len(steps), len(window.sample)))
            for at, (other, slot) in enumerate(zip(moved, [None] * here.own + [*here.slots], strict=True)):
                if slot is None or here.is_of(slot, window):
                    # With cached fields, only the effect whose parameter changed and the effects after it are
                    # computed again.
                    there = other.height(window, known=ChainMap({}, fields))
                    rows[at] = (window.at_sample(there) - value) / steps[at]
            basis = window.free_basis(prediction, FREE_TERMS).T
            linear.append(Linearised(window.height - value, rows, basis))
        return linear

    def residuals(self, vector: np.ndarray) -> list[np.ndarray]:
        """Return the measured minus the predicted heights of all windows at the given parameters, µm."""
        twin = self._twin.at(vector)
        return [window.height - window.at_sample(twin.height(window)) for window in self._windows]

    def room(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return two arrays: the lowest and the highest allowed step of each parameter. Steps within these
        limits keep all parameters within their ranges and change the parameters of the base only by small
        amounts.
        """
        return self._twin.at(vector).room()


def fit_state(twin: Twin, study: Study, *, from_here: bool = False) -> State:
    """Fit a model to all windows of a study. Then fit it again for each fold, without the windows of this
    fold.

    Args:
        twin: the model.
        study: the scans.
        from_here: whether to start only from the current parameters of the model. Otherwise, a second start
            is also tried, in which the parameters of the base have their default values. The start that leads
            to the smaller error is used.
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
    freed = [one.freed(left, own) for one, left, own in zip(windows, held_out, maps, strict=True)]
    return State(study, common, per_fold, linear, held_out, freed)


def _best_start(twin: Twin, windows: Sequence[PreparedScan]) -> np.ndarray:
    """Return the better of two starts of a fit. The first start has the current parameters. In the second
    start, the parameters of the base have their default values instead.

    The better start is the one from which a fit to some of the scans reaches the smaller error.

    When an effect is added to the model, the parameters of the base have already absorbed part of this
    effect. A fit that starts from these parameters may get stuck in a local optimum. For this reason, the
    second start is also tried.
    """
    unfitted = twin.with_base_unfitted().vector
    if not twin.slots or np.array_equal(unfitted, twin.vector):
        return twin.vector
    # Every third scan is enough to come close to the optimum.
    some = TwinProblem(twin, windows[::3] if len(windows) > 6 else windows)
    fits = [fit_least_squares(some, start, RULES) for start in (twin.vector, unfitted)]
    return min(fits, key=lambda fit: eliminated_sum(fit.linear, RULES.term_weight)[2]).vector


def _without(common: Twin, fold: int, linear: Sequence[Linearised], windows: Sequence[PreparedScan]) -> Twin:
    """Fit the model to the windows outside a fold, using the derivatives of the common fit.

    The fit starts from the parameters of the common fit, which used all windows. It must therefore be
    iterated to convergence, so that no information about the fold remains.
    """
    twin = common.of_fold(fold)
    problem, vector = TwinProblem(twin, windows), twin.vector
    if not len(vector):
        return twin
    if twin is not common:
        # The base of this fold differs from that of the common fit, so the residuals are computed again with
        # the base of this fold.
        linear = with_residuals(linear, problem.residuals(vector))
    normal, right, total = eliminated_sum(linear, RULES.term_weight)
    for _ in range(6):
        step = solve_damped(normal, right, 1e-6, twin.at(vector).room())
        trial = vector + step
        # If the predicted gain of a step is this small, the linear model is exact enough.
        if promised_gain(normal, right, step) <= 1e-4 * total:
            vector = trial
            break
        left = with_residuals(linear, problem.residuals(trial))
        _, right, squares = eliminated_sum(left, RULES.term_weight)
        if squares > total:
            break
        vector, total = trial, squares
    return twin.at(vector).known_from(windows)
