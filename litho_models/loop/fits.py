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
from operator import call
from typing import TypeVar

import numpy as np

from litho_data.commands.progress import progress
from litho_data.foundation import NM_PER_UM, Array
from litho_data.sharing.workers import HERE, Workers, run_jobs
from litho_data.store import PrintedScan
from litho_data.store.lock_box import field_of
from litho_models.effects.chain import Fields
from litho_models.fitting.least_squares import (
    Linearised,
    Room,
    Rules,
    eliminated_sum,
    fit_least_squares,
    promised_gain,
    solve_damped,
    with_residuals,
)
from litho_models.loop.model import FoldedBase, Twin
from litho_models.loop.prepared import FREE_TERMS, PreparedScan, prepare_scans
from litho_models.scan_terms.grouped import Labels, groupings
from litho_models.simulator import Simulator
from litho_models.splits.folds import grouped_folds

T = TypeVar("T")

RULES = Rules("squares", steps=24, tries=8, kept_above=0.8)

# A function that receives the progress messages.
Report = Callable[[str], None]


@dataclass(frozen=True)
class Study:
    """Scans with their folds, and the settings for judging findings.

    Attributes:
        scans: the prepared scans.
        fold_of: number of the fold of each scan, of shape (scans,). The folds are numbered from 0 without
            gaps.
        seed: seed of the folds, the calibration blocks and the permutations.
        workers: pool of processes for independent fits.
        report: function that receives the progress messages.
    """

    scans: Sequence[PreparedScan]
    fold_of: Array
    seed: int = 0
    workers: Workers = HERE
    report: Report = lambda message: None

    @classmethod
    def dealt(
        cls,
        scans: Sequence[PrintedScan],
        folds: int,
        seed: int = 0,
        workers: Workers = HERE,
        report: Report = lambda message: None,
    ) -> Study:
        """Prepare scans and divide them into at most ``folds`` folds."""
        ids = [scan.id for scan in scans]
        lists = grouped_folds(ids, [field_of(scan) for scan in scans], folds, seed)
        fold_of = np.argmax([[one in members for one in ids] for members in lists], axis=0)
        return cls(prepare_scans(scans), fold_of, seed, workers, report)

    def run(self, jobs: Sequence[Callable[[], T]], what: str) -> list[T]:
        """Run independent jobs in the pool of processes, and return their results in the order of the jobs.
        ``what`` says in the progress display and in messages what the jobs do.
        """
        done = run_jobs(call, jobs, self.workers, name=lambda job: f"{what}, part {jobs.index(job) + 1}")
        found = dict(progress(done, what, len(jobs)))
        return [found[job] for job in jobs]

    @property
    def folds(self) -> list[tuple[list[int], list[int]]]:
        """Return two lists of scan indices per fold: the scans outside the fold, and the scans inside it."""
        own = (self.fold_of == fold for fold in np.unique(self.fold_of))
        return [(np.flatnonzero(~one).tolist(), np.flatnonzero(one).tolist()) for one in own]

    @property
    def others(self) -> list[list[PreparedScan]]:
        """Return, for each fold, the scans outside this fold."""
        return [[self.scans[i] for i in rest] for rest, _ in self.folds]

    @property
    def windows(self) -> list[PreparedScan]:
        """Return the window of each scan, i.e. the part of the scan that is used for fits and screening."""
        return [scan.window for scan in self.scans]

    @property
    def of_films(self) -> bool:
        """Return whether the scans are electron micrographs of a film.

        For films, the positions of edges are scored instead of heights, and single scans have no height
        errors such as drift.
        """
        return self.scans[0].seen_by == "sem"

    @cached_property
    def groups(self) -> dict[str, Labels]:
        """Return, for each grouping of the scans, the label of the group to which each scan belongs. The
        result is keyed by the name of the grouping.
        """
        return groupings(self.scans)


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
    held_out_um: list[Array]
    freed_um: list[Array]
    # Refitted models that several steps of the loop need. A model without one effect has the name of this
    # effect as its key. A model with another base has this base, fitted without effects, as its key.
    _refitted: dict[str | State, State] = field(default_factory=dict, init=False)

    @cached_property
    def freed_nm2(self) -> Array:
        """Return the mean square of ``freed_um`` for each scan, nm², of shape (scans,)."""
        return np.array([NM_PER_UM**2 * np.mean(left**2) for left in self.freed_um])

    @property
    def mse_nm2(self) -> float:
        return float(self.freed_nm2.mean())

    def without(self, name: str) -> State:
        """Return the model without the named effect, refitted from the current parameters."""
        if name not in self._refitted:
            self._refitted[name] = fit_state(self.twin.without(name), self.study, from_here=True)
        return self._refitted[name]

    def on_base(self, start: State) -> State:
        """Fit the effects of this model together with another base model. ``start`` is the other base model,
        fitted without effects.
        """
        if start not in self._refitted:
            self._refitted[start] = fit_state(replace(start.twin, effects=self.twin.effects), start.study)
        return self._refitted[start]

    def maps_um(self, scans: Sequence[PreparedScan]) -> list[Array]:
        """Predict the height of the print in each scan (or window), µm, of shape (ny, nx). Each prediction is
        made by the model that was fitted without the fold of this scan.
        """
        return [
            self.per_fold[fold].height(scan) for fold, scan in zip(self.study.fold_of, scans, strict=True)
        ]


@dataclass(frozen=True)
class TwinProblem:
    """The least-squares problem of fitting a model to windows of scans. Derivatives are computed as
    difference quotients.
    """

    twin: Twin
    windows: Sequence[PreparedScan]

    def linearise(self, vector: Array) -> list[Linearised]:
        """Return the residuals, the derivatives and the free terms of all windows at the given parameters."""
        here = self.twin.at(vector)
        steps = here.steps()
        moved = [here.at(vector + one) for one in np.diag(steps)]
        linear = []
        for window in self.windows:
            fields: Fields = {}
            prediction = here.height(window, known=fields)
            value = window.at_sample(prediction)
            rows = np.zeros((len(steps), len(window.sample)))
            for at, other in enumerate(moved):
                if at < here.own or here.slots[at - here.own].is_of(window):
                    # With cached fields, only the effect whose parameter changed and the effects after it are
                    # computed again.
                    there = other.height(window, known=ChainMap({}, fields))
                    rows[at] = (window.at_sample(there) - value) / steps[at]
            linear.append(
                Linearised(window.residual(prediction), rows, window.free_basis(prediction, FREE_TERMS).T)
            )
        return linear

    def residuals(self, vector: Array) -> list[Array]:
        """Return the measured minus the predicted heights of all windows at the given parameters, µm."""
        twin = self.twin.at(vector)
        return [window.residual(twin.height(window)) for window in self.windows]

    def room(self, vector: Array) -> Room:
        """Return two arrays: the lowest and the highest allowed step of each parameter. Steps within these
        limits keep all parameters within their ranges and change the parameters of the base only by small
        amounts.
        """
        return self.twin.at(vector).room()


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
    free = common.free()[:, None]
    linear = [replace(part, jacobian=part.jacobian * free) for part in fitted.linear]
    per_fold = [
        _of_fold(common, fold, [fitted.linear[i] for i in own], [windows[i] for i in own])
        for fold, (own, _) in enumerate(study.folds)
    ]
    held_out, freed = [], []
    for fold, window in zip(study.fold_of, windows, strict=True):
        prediction = per_fold[fold].height(window)
        held_out.append(window.residual(prediction))
        freed.append(window.freed(held_out[-1], prediction))
    return State(study, common, per_fold, linear, held_out, freed)


def _best_start(twin: Twin, windows: Sequence[PreparedScan]) -> Array:
    """Return the better of two starts of a fit. The first start has the current parameters. In the second
    start, the parameters of the base have their default values instead.

    The better start is the one from which a fit to some of the scans reaches the smaller error.

    When an effect is added to the model, the parameters of the base have already absorbed part of this
    effect. A fit that starts from these parameters may get stuck in a local optimum. For this reason, the
    second start is also tried.
    """
    base = twin.base
    if not (twin.own and twin.slots and isinstance(base, Simulator)):
        return twin.vector
    unfitted = replace(twin, numbers=Twin.bare(type(base)(base.config)).numbers)
    if np.array_equal(unfitted.numbers, twin.numbers):
        return twin.vector
    # Every third scan is enough to come close to the optimum.
    some = TwinProblem(twin, windows[::3] if len(windows) > 6 else windows)
    fits = [fit_least_squares(some, start.vector, RULES) for start in (twin, unfitted)]
    return min(fits, key=lambda fit: eliminated_sum(fit.linear, RULES.term_weight)[2]).vector


def _of_fold(common: Twin, fold: int, linear: Sequence[Linearised], windows: Sequence[PreparedScan]) -> Twin:
    """Fit the model to the windows outside a fold, using the derivatives of the common fit.

    The fit starts from the parameters of the common fit, which used all windows. It must therefore be
    iterated to convergence, so that no information about the fold remains.
    """
    base = common.base
    twin = replace(common, base=base.models[fold]) if isinstance(base, FoldedBase) else common
    problem, vector = TwinProblem(twin, windows), twin.vector
    if not len(vector):
        return twin
    if twin is not common:
        # The base of this fold differs from that of the common fit, so the residuals are computed again with
        # the base of this fold.
        linear = with_residuals(linear, problem.residuals(vector))
    normal, right, total = eliminated_sum(linear, RULES.term_weight)
    for _ in range(6):
        step = solve_damped(normal, right, 1e-6, problem.room(vector))
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
