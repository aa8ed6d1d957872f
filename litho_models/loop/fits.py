"""Fits of a twin to scans: once to all of them, and once without each fold, which it then predicts.

What single scans may add is projected out, so that it cannot pull the numbers of the printer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.sharing.workers import HERE, Workers
from litho_data.store import PrintedScan
from litho_models.effects import get_effect
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

# What every scan may add in a fit: its gain is left to the process, which long-range effects act on.
FREE_TERMS: Terms = frozenset({"offset", "bow", "warp"})
# What a comparison of errors leaves to the single scans.
ALL_FREE: Terms = FREE_TERMS | {"gain"}
RULES = Rules("squares", steps=24, kept_above=0.8)


def _silent(message: str) -> None:
    pass


@dataclass(frozen=True)
class Study:
    """The scans, who holds each out, and how what is said of them is judged.

    Attributes:
        scans: prepared; ``fold_of``: (scans,) number of the fold that holds each out.
        seed: of folds, calibration blocks and permutations.
        workers: where independent fits are made; ``report``: told in a sentence what happens.
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
        """Scans of a store dealt into folds, one for each scan at most."""
        ids = [scan.id for scan in scans]
        lists = grouped_folds(ids, min(folds, len(ids)), seed)
        fold = {one: number for number, members in enumerate(lists) for one in members}
        return cls(prepare_scans(scans), np.array([fold[one] for one in ids]), seed, workers, report)

    def of_others(self, scans: Sequence[PrintedScan]) -> Study:
        """Other scans dealt alike, without a word."""
        return Study.dealt(scans, len(self.folds), self.seed, self.workers)

    def __getstate__(self) -> dict[str, object]:
        """In another process a study has no workers of its own, and nobody to tell."""
        return {**self.__dict__, "workers": HERE, "report": _silent}

    @property
    def folds(self) -> list[tuple[list[int], list[int]]]:
        """Of each fold the numbers of the scans that are not in it, and of those that are."""
        own = (self.fold_of == fold for fold in range(int(self.fold_of.max()) + 1))
        return [(np.flatnonzero(~one).tolist(), np.flatnonzero(one).tolist()) for one in own]

    @property
    def windows(self) -> list[PreparedScan]:
        """What fits and screening see of the scans."""
        return [scan.window for scan in self.scans]

    @property
    def tip_radius_um(self) -> float | None:
        """Radius of the tip, or the most that it can be, if the store knows: that of the first scan."""
        known = (scan.stored.tip_radius_um for scan in self.scans)
        return next((radius for radius in known if radius is not None), None)

    @property
    def of_films(self) -> bool:
        """Whether the scans are micrographs of a film: what counts are its edges, and no height drifts."""
        return self.scans[0].stored.seen_by == "sem"

    @cached_property
    def groups(self) -> dict[str, Labels]:
        """The groups that the scans fall into."""
        return groupings([scan.stored for scan in self.scans])


@dataclass(frozen=True, eq=False)
class State:
    """A twin fitted to the scans of a study.

    Attributes:
        twin: at the numbers fitted to all scans; ``per_fold``: the same, each fitted without its own scans.
        linear: each window at ``twin``: residual, derivatives, and what the scan may add by itself.
        held_out_um: residual (n,) of each window by the fit that has not seen it.
        freed_nm2: (scans,) squared error per pixel of ``held_out_um``, free of what single scans may add.
    """

    study: Study
    twin: Twin
    per_fold: list[Twin]
    linear: list[Linearised]
    held_out_um: list[np.ndarray]
    freed_nm2: np.ndarray
    # The model without each of its effects: several steps ask for the same one.
    _without: dict[str, State] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def mse_nm2(self) -> float:
        return float(self.freed_nm2.mean())

    def __getstate__(self) -> dict[str, object]:
        """It comes from another process without its scans."""
        return {**self.__dict__, "study": None}

    def without(self, name: str) -> State:
        """The model without one of its effects, fitted again from here."""
        if name not in self._without:
            self._without[name] = fit_state(self.twin.without(name), self.study, from_here=True)
        return self._without[name]

    def maps_um(self, scans: Sequence[PreparedScan]) -> list[np.ndarray]:
        """Predicted prints (y, x) of the scans or their windows, each by the twin that has not seen it."""
        folds = zip(self.study.fold_of, scans, strict=True)
        return [self.per_fold[fold].height(scan) for fold, scan in folds]


class TwinProblem:
    """A twin on windows of scans; derivatives are one-sided differences."""

    def __init__(self, twin: Twin, windows: Sequence[PreparedScan]):
        self._twin = twin
        self._windows = windows

    def linearise(self, vector: np.ndarray) -> list[Linearised]:
        """Residuals, derivatives and free terms of all windows."""
        here = self._twin.at(vector)
        steps = here.steps()
        moved = [here.at(vector + one) for one in np.diag(steps)]
        return [self._of_window(here, moved, steps, window) for window in self._windows]

    def _of_window(
        self, twin: Twin, moved: Sequence[Twin], steps: np.ndarray, window: PreparedScan
    ) -> Linearised:
        layout = twin.exposed(window)
        base = twin.base_height(layout, window)
        prediction = twin.height(window, base_um=base)
        value = window.at_sample(prediction)
        rows = np.zeros((len(steps), len(window.sample)))
        for at, (other, slot) in enumerate(zip(moved, [None] * twin.own + [*twin.slots], strict=True)):
            if slot is not None and not twin.is_of(slot, window):
                continue
            # Only what is before a number in the chain stays as it is.
            known = other.base_height(layout, window) if slot is None else None
            if slot is not None and get_effect(slot.effect).acts_on == "height":
                known = base
            rows[at] = (window.at_sample(other.height(window, base_um=known)) - value) / steps[at]
        return Linearised(window.height - value, rows, window.free_basis(prediction, FREE_TERMS).T)

    def residuals(self, vector: np.ndarray) -> list[np.ndarray]:
        """Measured minus predicted of all windows, µm."""
        twin = self._twin.at(vector)
        return [window.height - window.at_sample(twin.height(window)) for window in self._windows]

    def room(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Effects stay within their range, the base does not go too far at once."""
        return self._twin.at(vector).room()


def fit_state(twin: Twin, study: Study, *, from_here: bool = False) -> State:
    """Fit a twin to all windows of a study, then without each fold in turn.

    Args:
        from_here: begin where the twin stands, or else there or with the base as it is before any fit.
    """
    windows = study.windows
    start = twin.vector if from_here else _best_start(twin, windows)
    fitted = fit_least_squares(TwinProblem(twin, windows), start, RULES)
    common = twin.at(fitted.vector)
    free = common.free()
    linear = [replace(part, jacobian=part.jacobian * free[:, None]) for part in fitted.linear]
    per_fold = []
    for fold, (own, _) in enumerate(study.folds):
        per_fold.append(_without(common, fold, [fitted.linear[i] for i in own], [windows[i] for i in own]))
    maps = [per_fold[fold].height(one) for fold, one in zip(study.fold_of, windows, strict=True)]
    held_out = [one.height - one.at_sample(own) for one, own in zip(windows, maps, strict=True)]
    freed = [
        without_terms(left[:, None], window, own)
        for left, window, own in zip(held_out, windows, maps, strict=True)
    ]
    freed_nm2 = np.array([NM_PER_UM**2 * np.mean(left**2) for left in freed])
    return State(study, common, per_fold, linear, held_out, freed_nm2)


def _best_start(twin: Twin, windows: Sequence[PreparedScan]) -> np.ndarray:
    """Where the twin stands, or with the base's numbers before any fit: the better after a fit to some scans.

    The best base without an effect is no good place to look for one beside it: what the base took of the
    effect keeps it there, on the wrong side of a hill.
    """
    unfitted = twin.with_base_unfitted().vector
    if not twin.slots or np.array_equal(unfitted, twin.vector):
        return twin.vector
    # The way to the neighbourhood of the optimum is walked on every third scan.
    some = TwinProblem(twin, windows[::3] if len(windows) > 6 else windows)
    fits = [fit_least_squares(some, start, RULES) for start in (twin.vector, unfitted)]
    return min(fits, key=lambda fit: eliminated_sum(fit.linear, RULES.term_weight)[2]).vector


def without_terms(
    columns: np.ndarray, window: PreparedScan, prediction_um: np.ndarray, terms: Terms = ALL_FREE
) -> np.ndarray:
    """Columns (n, m) at the sampled pixels, without what a single scan may add to a prediction (y, x), µm."""
    basis = window.free_basis(prediction_um, terms)
    return columns - basis @ (basis.T @ columns)


def _without(common: Twin, fold: int, linear: Sequence[Linearised], windows: Sequence[PreparedScan]) -> Twin:
    """The twin fitted to some of the windows with the derivatives of the common fit.

    The common fit, which has seen all windows, is where it starts: nothing may be left there.
    """
    twin = common.of_fold(fold)
    problem, vector = TwinProblem(twin, windows), twin.vector
    if not len(vector):
        return twin
    if twin is not common:
        # At the common fit each window was predicted by a model that has seen the fold.
        linear = with_residuals(linear, problem.residuals(vector))
    normal, right, total = eliminated_sum(linear, RULES.term_weight)
    for _ in range(6):
        step = solve_damped(normal, right, 1e-6, twin.at(vector).room())
        trial = vector + step
        # So small a step is what the derivatives say.
        if promised_gain(normal, right, step) <= 1e-4 * total:
            vector = trial
            break
        left = with_residuals(linear, problem.residuals(trial))
        _, right, squares = eliminated_sum(left, RULES.term_weight)
        if squares > total:
            break
        vector, total = trial, squares
    return twin.at(vector).known_from(windows)
