"""Close the loop on a set of scans: from the residual of a base to causes, laws and what is left.

``close`` is an estimator: it chooses and fits on the scans that it is given, and what it returns predicts any
other scan. Whatever is judged on scans is chosen without them by calling it on the rest.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from torch import nn

from litho_data.store import PrintedScan
from litho_models.effects import Effect, screened_effects
from litho_models.effects.laws import LAWS, TABLES
from litho_models.fitting.least_squares import fit_least_squares
from litho_models.loop.checking import Check, Checked
from litho_models.loop.fits import RULES, State, Study, TwinProblem, fit_state, held_out_maps
from litho_models.loop.judging import judge
from litho_models.loop.learner import Learner, Rest
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan, prepare_scans, prepared_among
from litho_models.loop.search import Cause, Found, describe, search, untestable
from litho_models.loop.trials import Secants
from litho_models.scan_terms.grouped import ALL
from litho_models.scan_terms.measurement import MeasurementModel
from litho_models.scan_terms.measurement_fit import learn_measurement


@dataclass(frozen=True)
class Chosen:
    """Two searches, one beside the other, and what lies in neither.

    Attributes:
        named: among causes; ``checked``: they and those that failed, with their checks.
        lawful: among short laws.
        described: tables over a covariate, which say where the rest lies; the model has them last.
    """

    named: Found
    checked: list[Checked]
    lawful: Found
    described: Found


@dataclass(frozen=True)
class Closed:
    """What was chosen and fitted on some scans.

    Attributes:
        study: the scans, freed of what they share by group.
        plain: the base fitted to the scans as they are; ``base``: to the freed ones.
        rests: what features of layout and place still explain, by stage.
        untestable: effects that could not be tested, with the reason.
    """

    study: Study
    original: Sequence[PreparedScan]
    plain: State
    base: State
    chosen: Chosen
    rests: dict[str, Rest]
    untestable: dict[str, str]

    @property
    def final(self) -> State:
        """The corrected model: causes, laws, and tables where neither holds."""
        return self.chosen.described.state

    @property
    def causes(self) -> list[Cause]:
        """Named causes whose formula stands."""
        return self.chosen.named.causes

    @property
    def traced(self) -> list[Cause]:
        """Causes and laws."""
        return [*self.causes, *self.chosen.lawful.causes]

    @property
    def found(self) -> list[Cause]:
        """All that is reported."""
        return [*self.traced, *self.chosen.described.causes]


def close(
    scans: Sequence[PrintedScan],
    fold_of: np.ndarray,
    base: nn.Module,
    study: Study,
) -> Closed:
    """Find what a base lacks on these scans.

    Args:
        scans: development scans; ``fold_of``: (scans,) fold that holds each out.
        base: simulator with few parameters, which is refitted, or one that is taken as it is.
        study: settings: seed, workers, report.
    """
    original = prepare_scans(scans)
    plain = replace(study, scans=original, fold_of=fold_of)
    study.report(f"fitting the base model on {len(scans)} scans")
    first = fit_state(Twin.bare(copy.deepcopy(base), original[0]), plain)
    study.report("learning what scans of a group share")
    freed = freed_scans(scans, first, plain)
    at_work = replace(plain, scans=prepare_scans(freed))
    start = fit_state(first.twin, at_work)

    @cache
    def learner() -> Learner:
        return Learner(at_work, held_out_maps(start.per_fold, at_work, at_work.scans))

    excluded = untestable(at_work)
    causes = [
        one
        for one in screened_effects(at_work.tip_radius_um)
        if one.name not in excluded and one.of_films == at_work.of_films
    ]
    chosen = _chosen(start, at_work, causes, learner)
    # By the model, so that a stage that changes nothing counts with the one before it.
    stages: dict[State, str] = {start: "base"}
    stages.setdefault(chosen.named.state, "causes")
    stages.setdefault(chosen.lawful.state, "laws")
    stages.setdefault(chosen.described.state, "tables")
    return Closed(
        study=at_work,
        original=original,
        plain=first,
        base=start,
        chosen=chosen,
        rests={
            name: learner().rest(held_out_maps(state.per_fold, at_work, at_work.scans))
            for state, name in stages.items()
        },
        untestable=excluded,
    )


def _chosen(
    start: State, study: Study, candidates: Sequence[Effect], learner: Callable[[], Learner]
) -> Chosen:
    """Each cause is checked with everything else in place.

    One that fails is taken out, and laws are sought anew without it.
    """
    named = search(start, study, candidates)
    failed: list[Checked] = []
    # Laws and tables are of heights.
    laws, tables = ([], []) if study.of_films else (list(LAWS.values()), list(TABLES.values()))
    secants = Secants(start.twin, study.windows)
    while True:
        study.report("looking for a law in what is left")
        # Two terms at most, so that a law is a short formula.
        lawful = search(named.state, study, laws, 2, secants)
        study.report("describing what is left")
        described = describe(lawful.state, study, tables, 2, secants)
        checked: list[Checked] = []
        if named.causes:
            in_place = _with_larger_table(lawful.state, described, start.mse_nm2 - named.state.mse_nm2, study)
            left_nm2 = learner().rest(held_out_maps(in_place.per_fold, study, study.scans)).mean_nm2
            check = Check(in_place, [*named.causes, *lawful.causes], laws, left_nm2, secants, study)
            checked = [check.of(cause) for cause in named.causes]
            if not any(one.reason for one in checked):
                checked = [check.beside_laws(one) for one in checked]
            named.causes = [one.cause for one in checked]
        wrong = [one for one in checked if one.reason]
        if not wrong:
            return Chosen(named, [*checked, *failed], lawful, _in_model(lawful.state, described, study))
        # What may only correct another formula goes first: that formula is then judged without it.
        wrong.sort(key=lambda one: one.cause.judgement.gain_nm2)
        out = [one for one in wrong if one.corrects] or wrong[:1]
        for one in out:
            study.report(f"{one.cause.name}: {one.reason}")
            named.refused[one.cause.name] = one.reason
            named.state = named.state.without(one.cause.name, study)
        failed += out
        names = {one.cause.name for one in out}
        named.causes = [cause for cause in named.causes if cause.name not in names]
        if not named.causes:
            named.state = start


def _in_model(state: State, described: Sequence[Cause], study: Study) -> Found:
    """The model with every table that is confirmed there too, fitted beside all the rest."""
    found = Found(state)
    for table in described:
        fitted = _with_table(found.state, table, study)
        judgement = judge(found.state.freed_nm2, fitted.freed_nm2, study)
        if judgement.passed(grouped=table.by != ALL):
            found.state = fitted
            found.causes.append(replace(table, judgement=judgement))
    return found


def _with_larger_table(state: State, described: Sequence[Cause], named_nm2: float, study: Study) -> State:
    """The model, with the largest table beside it if that takes more than all causes together.

    A table follows whatever it can. It is held against all causes, not against single ones.
    """
    table = max(described, key=lambda one: one.judgement.gain_nm2, default=None)
    if table is None or table.judgement.gain_nm2 <= named_nm2:
        return state
    return _with_table(state, table, study)


def _with_table(state: State, table: Cause, study: Study) -> State:
    return fit_state(state.twin.with_effect(table.name, table.by, table.values), study, from_here=True)


class Fit(NamedTuple):
    """Printer and measurement fitted to the same scans."""

    twin: Twin
    measurement: MeasurementModel

    @property
    def numbers(self) -> tuple[int, int]:
        """Fitted numbers of printer and measurement."""
        return len(self.twin.vector), self.measurement.numbers

    def expected_um(self, scans: Sequence[PreparedScan]) -> list[np.ndarray]:
        """Maps (y, x) that the scans should show."""
        placed = self.twin.placed()
        return [self.measurement.expected_um(scan.stored, placed.height(scan)) for scan in scans]


def freed_scans(scans: Sequence[PrintedScan], state: State, study: Study) -> list[PrintedScan]:
    """The scans without what those of a group share beside their prints.

    What all scans share stays in: a cause may have it. A scan is freed by what was learned without its fold.
    """
    maps = held_out_maps(state.per_fold, study, study.scans)
    freed = list(scans)
    for fold in study.folds:
        own = np.flatnonzero(study.fold_of != fold).tolist()
        if len(own) < 2:
            continue
        learned = learn_measurement([scans[i] for i in own], [maps[i] for i in own], seed=study.seed)
        differences = learned.between_groups()
        for i in np.flatnonzero(study.fold_of == fold).tolist():
            freed[i] = differences.freed(scans[i], maps[i])
    return freed


def fit_with_measurement(twin: Twin, scans: Sequence[PreparedScan], seed: int = 0, refit: bool = True) -> Fit:
    """Printer and measurement fitted to the same scans, one after the other, and the strengths once more.

    Args:
        twin: where the fit of the printer begins; ``scans``: as they are, freed of nothing.
        refit: the printer, once the measurement is known; or leave it where it is.
    """
    stored = [scan.stored for scan in scans]

    def learned(like: MeasurementModel | None = None) -> tuple[MeasurementModel, list[np.ndarray]]:
        placed = twin.placed()
        maps = [placed.height(scan) for scan in scans]
        return learn_measurement(stored, maps, seed=seed, like=like), maps

    measurement, maps = learned()
    if refit and len(twin.vector):
        freed = [measurement.freed(scan, own) for scan, own in zip(stored, maps, strict=True)]
        windows = [scan.window for scan in prepared_among(freed, scans)]
        twin = twin.at(fit_least_squares(TwinProblem(twin, windows), twin.vector, RULES).vector)
        measurement, _ = learned(like=measurement)
    return Fit(twin, measurement)
