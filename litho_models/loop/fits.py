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
    orthonormal,
    promised_gain,
    solve_damped,
    with_residuals,
)
from litho_models.loop.folded_base import FoldedBase
from litho_models.loop.model import Placed, Twin, exposed, finished
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.scan_terms import Terms
from litho_models.scan_terms.grouped import Labels, groupings

# What every scan may add in a fit: its gain is left to the process, which long-range effects act on.
FREE_TERMS: Terms = frozenset({"offset", "bow", "warp"})
# What a comparison of errors leaves to the single scans.
ALL_FREE: Terms = FREE_TERMS | {"gain"}
RULES = Rules("squares", steps=24, kept_above=0.8)
# The way to the neighbourhood of the optimum is walked on every third scan.
_START_EVERY = 3
# A fit without a fold starts at the common one and takes its derivatives.
_FOLD_STEPS, _FOLD_GAIN, _FOLD_DAMPING = 6, 1e-4, 1e-6


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

    def __getstate__(self) -> dict[str, object]:
        """In another process a study has no workers of its own, and nobody to tell."""
        return {**self.__dict__, "workers": HERE, "report": _silent}

    @property
    def folds(self) -> range:
        return range(int(self.fold_of.max()) + 1)

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


@dataclass(frozen=True)
class State:
    """A fitted twin.

    Attributes:
        twin: at the numbers fitted to all scans; ``per_fold``: (folds, p), each without its own scans.
        linear: each window at ``twin``: residual, derivatives, and what the scan may add by itself.
        held_out_um: residual (n,) of each window by the fit that has not seen it.
        freed_nm2: (scans,) squared error per pixel of ``held_out_um``, free of what single scans may add.
    """

    twin: Twin
    per_fold: np.ndarray
    linear: list[Linearised]
    held_out_um: list[np.ndarray]
    freed_nm2: np.ndarray
    # The model without each of its effects: several steps ask for the same one.
    _without: dict[str, State] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def mse_nm2(self) -> float:
        return float(self.freed_nm2.mean())

    def without(self, name: str, study: Study) -> State:
        """The model without one of its effects, fitted again from here."""
        if name not in self._without:
            self._without[name] = fit_state(self.twin.without(name), study, from_here=True)
        return self._without[name]


def prepared_among(scans: Sequence[PrintedScan], known: Sequence[PreparedScan]) -> list[PreparedScan]:
    """Scans prepared with places in the writing order of those that a model is known from."""
    orders, places = zip(*sorted((one.stored.order, one.context.order) for one in known), strict=True)

    def placed(scan: PreparedScan) -> PreparedScan:
        order = float(np.interp(scan.stored.order, orders, places))
        part = None if scan.quadrant is None else placed(scan.quadrant)
        return replace(scan, context=replace(scan.context, order=order), quadrant=part)

    return [placed(scan) for scan in prepare_scans(scans)]


class TwinProblem:
    """A twin on windows of scans; derivatives are one-sided differences.

    Args:
        fold: of a base that was trained without each fold, the one without this fold; None: for each window
            the one that has not seen it.
    """

    def __init__(self, twin: Twin, windows: Sequence[PreparedScan], fold: int | None = None):
        self._twin = twin
        self._windows = windows
        self._fold = fold

    def linearise(self, vector: np.ndarray) -> list[Linearised]:
        """Residuals, derivatives and free terms of all windows."""
        here = self._twin.at(vector)
        placed, steps = here.placed(), here.steps()
        moved = [
            here.at(vector + step * (np.arange(len(vector)) == i)).placed() for i, step in enumerate(steps)
        ]
        return [self._of_window(placed, moved, steps, window) for window in self._windows]

    def _of_window(
        self, placed: Placed, moved: Sequence[Placed], steps: np.ndarray, window: PreparedScan
    ) -> Linearised:
        twin, own = placed.twin, placed.twin.own
        chain = placed.chain(window)
        layout = exposed(chain, window)
        base = placed.height_of(layout, window, self._fold)
        prediction = finished(chain, base, window)
        value = window.at_sample(prediction)
        rows = np.zeros((len(steps), len(window.sample)))
        for i, (other, step) in enumerate(zip(moved, steps, strict=True)):
            slot = twin.slots[i - own] if i >= own else None
            if slot is not None and not twin.is_of(slot, window):
                continue
            there = other.chain(window)
            # Only what is before a number in the chain stays as it is.
            if slot is None:
                height = other.height_of(layout, window, self._fold)
            elif get_effect(slot.effect).acts_on == "height":
                height = base
            else:
                height = other.base_height(there, window, self._fold)
            rows[i] = (window.at_sample(finished(there, height, window)) - value) / step
        basis = orthonormal(window.terms_at_sample(prediction, FREE_TERMS).T).T
        return Linearised(window.height - value, rows, basis)

    def residuals(self, vector: np.ndarray) -> list[np.ndarray]:
        """Measured minus predicted of all windows, µm."""
        placed = self._twin.at(vector).placed()
        return [w.height - w.at_sample(placed.height(w, self._fold)) for w in self._windows]

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
    per_fold, held_out = [], [np.empty(0)] * len(windows)
    freed = np.empty(len(windows))
    for fold in study.folds:
        own = [i for i, of in enumerate(study.fold_of) if of != fold]
        vector = _without(common, [fitted.linear[i] for i in own], [windows[i] for i in own], fold)
        per_fold.append(vector)
        placed = common.at(vector).placed()
        for i in np.flatnonzero(study.fold_of == fold):
            prediction = placed.height(windows[i], fold)
            held_out[i] = windows[i].height - windows[i].at_sample(prediction)
            left = without_terms(held_out[i][:, None], windows[i], prediction)
            freed[i] = NM_PER_UM**2 * float(np.mean(left**2))
    return State(common, np.stack(per_fold), linear, held_out, freed)


def _best_start(twin: Twin, windows: Sequence[PreparedScan]) -> np.ndarray:
    """Where the twin stands, or with the base's numbers before any fit: the better after a fit to some scans.

    The best base without an effect is no good place to look for one beside it: what the base took of the
    effect keeps it there, on the wrong side of a hill.
    """
    unfitted = twin.with_base_unfitted()
    if not twin.slots or np.array_equal(unfitted, twin.vector):
        return twin.vector
    some = TwinProblem(twin, windows[::_START_EVERY] if len(windows) > 2 * _START_EVERY else windows)
    fits = [fit_least_squares(some, start, RULES) for start in (twin.vector, unfitted)]
    return min(fits, key=lambda fit: eliminated_sum(fit.linear, RULES.term_weight)[2]).vector


def without_terms(
    columns: np.ndarray, window: PreparedScan, prediction_um: np.ndarray, terms: Terms = ALL_FREE
) -> np.ndarray:
    """Columns (n, m) at the sampled pixels, without what a single scan may add to a prediction (y, x), µm."""
    basis = orthonormal(window.terms_at_sample(prediction_um, terms).T)
    return columns - basis @ (basis.T @ columns)


def _without(
    common: Twin, linear: Sequence[Linearised], windows: Sequence[PreparedScan], fold: int
) -> np.ndarray:
    """Numbers fitted to some of the windows with the derivatives of the common fit.

    The common fit, which has seen all windows, is where it starts: nothing may be left there.
    """
    vector = common.vector
    if not len(vector):
        return vector
    if isinstance(common.base, FoldedBase):
        # At the common fit each window was predicted by a model that has seen the fold.
        left = TwinProblem(common, windows, fold).residuals(vector)
        linear = with_residuals(linear, left)
    normal, right, total = eliminated_sum(linear, RULES.term_weight)
    for _ in range(_FOLD_STEPS):
        step = solve_damped(normal, right, _FOLD_DAMPING, common.at(vector).room())
        trial = vector + step
        # So small a step is what the derivatives say.
        if promised_gain(normal, right, step) <= _FOLD_GAIN * total:
            vector = trial
            break
        left = TwinProblem(common, windows, fold).residuals(trial)
        _, right, squares = eliminated_sum(with_residuals(linear, left), RULES.term_weight)
        if squares > total:
            break
        vector, total = trial, squares
    return common.at(vector).known_from(windows).vector
