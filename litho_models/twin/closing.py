"""Close the loop on a set of scans: from the residual of a base to causes, laws and what is left.

``close`` is an estimator: it chooses and fits on the scans that it is given, and what it returns predicts any
other scan. Whatever is judged on scans is chosen without them by calling it on the rest.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import nn

from litho_data.store import PrintedScan
from litho_models.effects import Effect, screened_effects
from litho_models.effects.laws import DESCRIPTIONS, LAWS
from litho_models.loop.explainable import Learner, Rest
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.scan_terms.measurement import MeasurementModel, learn_measurement
from litho_models.twin.adequacy import reshaped_gain
from litho_models.twin.fits import State, Study, fit_state
from litho_models.twin.model import Twin
from litho_models.twin.search import Cause, Found, search, untestable

# Of a cause's gain: what its change in other shapes may take beside it. Formulas of the true causes leave less
# than 1 %, of those that only resemble one 20 % and more, on trials of the virtual fab.
FORM_SHARE = 0.05
# A law is a short formula: two terms at most.
MOST_LAWS, MOST_DESCRIPTIONS = 2, 2


@dataclass(frozen=True)
class Checked:
    """A cause with the check of its formula, nm² on held-out scans.

    Attributes:
        cause: what was added; ``reshaped_nm2``: what its change in other shapes would take beside it.
        holds: whether the formula stands.
    """

    cause: Cause
    reshaped_nm2: float

    @property
    def holds(self) -> bool:
        return self.reshaped_nm2 <= FORM_SHARE * self.cause.judgement.gain_nm2


@dataclass(frozen=True)
class Closed:
    """What was chosen and fitted on some scans.

    Attributes:
        study: the scans, freed of what they share by group.
        base, final: the fitted base, and the model with all that was added.
        named: the search among causes; ``checked``: each of its causes with the check of its formula.
        lawful, described: the searches among laws and descriptions, each beside all before.
        rests: what features of layout and place still explain, by stage.
        untestable: effects that could not be tested, with the reason.
    """

    study: Study
    original: Sequence[PreparedScan]
    base: State
    named: Found
    checked: list[Checked]
    lawful: Found
    described: Found
    rests: dict[str, Rest]
    untestable: dict[str, str]

    @property
    def final(self) -> State:
        return self.described.state

    @property
    def causes(self) -> list[Cause]:
        """Named causes whose formula stands."""
        return [one.cause for one in self.checked if one.holds]


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
    start = fit_state(Twin.bare(copy.deepcopy(base), original[0]), plain)
    study.report("learning what scans of a group share")
    freed = freed_scans(scans, start, plain)
    at_work = replace(plain, scans=prepare_scans(freed))
    start = fit_state(start.twin, at_work)
    excluded = untestable(at_work)
    causes = [one for one in screened_effects(at_work.tip_radius_um) if one.name not in excluded]
    named, checked = _named(start, at_work, causes)
    study.report("looking for a law in what is left")
    lawful = search(named.state, at_work, list(LAWS.values()), MOST_LAWS)
    study.report("describing what is left")
    described = search(lawful.state, at_work, list(DESCRIPTIONS.values()), MOST_DESCRIPTIONS)
    stages = {"base": start, "causes": named.state, "laws": lawful.state, "all": described.state}
    return Closed(
        study=at_work,
        original=original,
        base=start,
        named=named,
        checked=checked,
        lawful=lawful,
        described=described,
        rests=_rests(stages, at_work),
        untestable=excluded,
    )


def _named(start: State, study: Study, candidates: Sequence[Effect]) -> tuple[Found, list[Checked]]:
    """The causes, each with the check of its formula; those that fail are taken out again."""
    found = search(start, study, candidates)
    checked = []
    for cause in list(found.causes):
        without = fit_state(found.state.twin.without(cause.name), study)
        reshaped, _ = reshaped_gain(without, found.state, study)
        checked.append(Checked(cause, reshaped))
    failed = [one.cause.name for one in checked if not one.holds]
    if failed:
        twin = found.state.twin
        for name in failed:
            twin = twin.without(name)
        found.causes = [cause for cause in found.causes if cause.name not in failed]
        found.state = fit_state(twin, study) if found.causes else start
        for one in checked:
            if not one.holds:
                share = 100 * one.reshaped_nm2 / one.cause.judgement.gain_nm2
                found.refused[one.cause.name] = (
                    f"only resembles the cause: its change in another shape takes {share:.0f} % of its gain more"
                )
    return found, checked


def held_out_maps(state: State, study: Study, scans: Sequence[PreparedScan]) -> list[np.ndarray]:
    """Predicted prints (y, x), µm, each by the fit that has not seen the scan."""
    placed = [state.twin.at(vector).placed() for vector in state.per_fold]
    return [placed[fold].height(scan, int(fold)) for fold, scan in zip(study.fold_of, scans, strict=True)]


def freed_scans(scans: Sequence[PrintedScan], state: State, study: Study) -> list[PrintedScan]:
    """The scans without what those of a group share beside their prints.

    What all scans share stays in: a cause may have it. Each scan is freed by what was learned without its fold.
    """
    maps = held_out_maps(state, study, study.scans)
    freed = list(scans)
    for fold in study.folds:
        own = np.flatnonzero(study.fold_of != fold)
        if len(own) < 2:
            continue
        learned = learn_measurement([scans[i] for i in own], [maps[i] for i in own], seed=study.seed)
        differences = learned.between_groups()
        for i in np.flatnonzero(study.fold_of == fold):
            extra = differences.expected_um(scans[i], maps[i]) - maps[i]
            freed[i] = replace(scans[i], height_um=(scans[i].height_um - extra).astype(np.float32))
    return freed


def measured_by_fold(
    scans: Sequence[PrintedScan], state: State, study: Study, prepared: Sequence[PreparedScan]
) -> list[np.ndarray]:
    """The map (y, x), µm, that each scan should show: print and measurement, both learned without its fold."""
    expected: list[np.ndarray] = [np.empty(0)] * len(scans)
    for fold in study.folds:
        placed = state.twin.at(state.per_fold[fold]).placed()
        maps = [placed.height(one, int(fold)) for one in prepared]
        own = np.flatnonzero(study.fold_of != fold)
        learned = learn_measurement([scans[i] for i in own], [maps[i] for i in own], seed=study.seed)
        for i in np.flatnonzero(study.fold_of == fold):
            expected[i] = learned.expected_um(scans[i], maps[i])
    return expected


def predict_elsewhere(
    closed: Closed, state: State, scans: Sequence[PrintedScan], learned: MeasurementModel | None = None
) -> list[np.ndarray]:
    """The maps (y, x), µm, of scans that took no part, by the fit to all that did."""
    placed = state.twin.placed()
    if learned is None:
        own = [scan.stored for scan in closed.original]
        learned = learn_measurement(
            own, [placed.height(one) for one in closed.original], seed=closed.study.seed
        )
    return [
        learned.expected_um(scan, placed.height(one))
        for scan, one in zip(scans, prepare_scans(scans), strict=True)
    ]


def _rests(stages: dict[str, State], study: Study) -> dict[str, Rest]:
    learner, rests, seen = None, {}, []
    for name, state in stages.items():
        if any(state is other for other in seen):
            continue
        seen.append(state)
        maps = held_out_maps(state, study, study.scans)
        learner = learner or Learner(study, maps)  # type: ignore[arg-type]
        rests[name] = learner.rest(maps)
    return rests
