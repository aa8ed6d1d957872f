"""Close the loop on a set of scans: from the residual of a base to causes, laws and what is left.

``close`` is an estimator: it chooses and fits on the scans that it is given, and what it returns predicts any
other scan. Whatever is judged on scans is chosen without them by calling it on the rest.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from torch import nn

from litho_data.store import PrintedScan
from litho_models.effects import Effect, screened_effects
from litho_models.effects.laws import DESCRIPTIONS, LAWS
from litho_models.fitting.least_squares import fit_least_squares
from litho_models.loop.adequacy import reshaped_gain
from litho_models.loop.fits import RULES, State, Study, TwinProblem, fit_state, prepared_among
from litho_models.loop.judging import judge
from litho_models.loop.learner import Learner, Rest
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.loop.search import Cause, Found, search, untestable
from litho_models.loop.search import describe as describe_rest
from litho_models.scan_terms.measurement import MeasurementModel, learn_measurement

# Of a cause's gain: what its change in other shapes may take beside it. On trials of the virtual fab the
# formulas of true causes leave less than 1 % (layer-stacking 10 %), of causes that only resemble one 20 % and
# more.
FORM_SHARE = 0.15
# Of what is left to be explained: less is the little that any columns take of causes that are still missing.
LEFT_SHARE = 0.3
# A cause that gains this little beside another may be an error of the other's formula: it is, if the other's
# change in another shape would take half of what it takes.
SMALL_SHARE, REPEATED_SHARE = 0.1, 0.5
# A law is a short formula: two terms at most.
MOST_LAWS, MOST_DESCRIPTIONS = 2, 2


@dataclass(frozen=True)
class Checked:
    """A cause with the check of its formula, nm² on held-out scans.

    Attributes:
        cause: what was added; ``reshaped_nm2``: what its change in other shapes would take beside it.
        left_nm2: what all features of layout and place still explain beside everything named.
        corrects: a much larger cause whose formula it may only correct; empty if none.
        exhausted: its amplitudes whose fit ends at the limit of their range.
    """

    cause: Cause
    reshaped_nm2: float
    left_nm2: float = 0.0
    corrects: str = ""
    exhausted: Sequence[str] = ()

    @property
    def gain_nm2(self) -> float:
        return self.cause.judgement.gain_nm2

    @property
    def reshaped_share(self) -> float:
        """Of the cause's own gain."""
        return self.reshaped_nm2 / max(self.gain_nm2, 1e-9)

    @property
    def holds(self) -> bool:
        """Whether the name stands."""
        return not self.reason

    @property
    def reason(self) -> str:
        """Why the name does not stand; empty if it does."""
        if self.corrects:
            return f"may only correct the formula of {self.corrects}"
        if self.exhausted:
            return f"the scans ask for more of it than there can be: {', '.join(self.exhausted)}"
        if self.reshaped_share > FORM_SHARE and self.reshaped_nm2 > LEFT_SHARE * self.left_nm2:
            share = 100 * self.reshaped_share
            return (
                f"only resembles the cause: its change in another shape takes {share:.0f} % of its gain more"
            )
        return ""


@dataclass(frozen=True)
class Closed:
    """What was chosen and fitted on some scans.

    Attributes:
        study: the scans, freed of what they share by group.
        plain: the base fitted to the scans as they are; ``base``: to the freed ones.
        named: the search among causes; ``checked``: each of its causes with the check of its formula.
        lawful: the search among laws, beside the causes; ``described``: where the rest lies, beside both.
        rests: what features of layout and place still explain, by stage.
        untestable: effects that could not be tested, with the reason.
    """

    study: Study
    original: Sequence[PreparedScan]
    plain: State
    base: State
    named: Found
    checked: list[Checked]
    lawful: Found
    described: list[Cause]
    rests: dict[str, Rest]
    untestable: dict[str, str]

    @property
    def final(self) -> State:
        """The corrected model: causes and laws. A description says where the rest lies, no more."""
        return self.lawful.state

    @property
    def causes(self) -> list[Cause]:
        """Named causes whose formula stands."""
        return [one.cause for one in self.checked if one.holds]


def close(
    scans: Sequence[PrintedScan],
    fold_of: np.ndarray,
    base: nn.Module,
    study: Study,
    *,
    describe: bool = True,
) -> Closed:
    """Find what a base lacks on these scans.

    Args:
        scans: development scans; ``fold_of``: (scans,) fold that holds each out.
        base: simulator with few parameters, which is refitted, or one that is taken as it is.
        study: settings: seed, workers, report.
        describe: also say where the rest lies, which changes no model.
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
        return Learner(at_work, held_out_maps(start, at_work, at_work.scans))

    excluded = untestable(at_work)
    causes = [one for one in screened_effects(at_work.tip_radius_um) if one.name not in excluded]
    named, checked = _named(start, at_work, causes, learner)
    study.report("looking for a law in what is left")
    lawful = search(named.state, at_work, list(LAWS.values()), MOST_LAWS)
    described: list[Cause] = []
    if describe:
        study.report("describing what is left")
        described = describe_rest(lawful.state, at_work, list(DESCRIPTIONS.values()), MOST_DESCRIPTIONS)
    stages = {"base": start, "causes": named.state, "laws": lawful.state}
    return Closed(
        study=at_work,
        original=original,
        plain=first,
        base=start,
        named=named,
        checked=checked,
        lawful=lawful,
        described=described,
        rests=_rests(stages, at_work, learner()) if describe else {},
        untestable=excluded,
    )


def _named(
    start: State, study: Study, candidates: Sequence[Effect], learner: Callable[[], Learner]
) -> tuple[Found, list[Checked]]:
    """The causes, each with the check of its formula; those that fail are taken out, one after the other."""
    found = search(start, study, candidates)
    failed: list[Checked] = []
    while found.causes:
        left_nm2 = learner().rest(held_out_maps(found.state, study, study.scans)).mean_nm2
        checked = [_checked(cause, found, left_nm2, study) for cause in found.causes]
        found.causes = [one.cause for one in checked]
        # What may only correct another formula goes first: that formula is then judged without it.
        wrong = sorted(
            (one for one in checked if not one.holds), key=lambda one: (not one.corrects, one.gain_nm2)
        )
        if not wrong:
            return found, [*checked, *failed]
        name, reason = wrong[0].cause.name, wrong[0].reason
        study.report(f"{name}: {reason}")
        failed.append(wrong[0])
        found.refused[name] = reason
        found.causes = [cause for cause in found.causes if cause.name != name]
        found.state = found.state.without(name, study) if found.causes else start
    return found, failed


def _checked(cause: Cause, found: Found, left_nm2: float, study: Study) -> Checked:
    """A cause, judged with all others in place."""
    without = found.state.without(cause.name, study)
    cause = replace(cause, judgement=judge(without.freed_nm2, found.state.freed_nm2, study))
    reshaped_nm2 = reshaped_gain(without, found.state, study)
    return Checked(
        cause, reshaped_nm2, left_nm2, _larger(cause, found, study), found.state.twin.exhausts(cause.name)
    )


def _larger(cause: Cause, found: Found, study: Study) -> str:
    """A much larger cause whose change in another shape takes what this one does; empty if none."""
    gain, without = cause.judgement.gain_nm2, found.state.without(cause.name, study)
    for other in found.causes:
        if gain < SMALL_SHARE * other.judgement.gain_nm2:
            neither = without.without(other.name, study)
            if reshaped_gain(neither, without, study) >= REPEATED_SHARE * gain:
                return other.name
    return ""


def held_out_maps(state: State, study: Study, scans: Sequence[PreparedScan]) -> list[np.ndarray]:
    """Predicted prints (y, x), µm, each by the fit that has not seen the scan."""
    placed = [state.twin.at(vector).placed() for vector in state.per_fold]
    return [placed[fold].height(scan, int(fold)) for fold, scan in zip(study.fold_of, scans, strict=True)]


def freed_scans(scans: Sequence[PrintedScan], state: State, study: Study) -> list[PrintedScan]:
    """The scans without what those of a group share beside their prints.

    What all scans share stays in: a cause may have it. A scan is freed by what was learned without its fold.
    """
    maps = held_out_maps(state, study, study.scans)
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


def fit_with_measurement(
    twin: Twin, scans: Sequence[PreparedScan], seed: int = 0, fold: int | None = None, refit: bool = True
) -> tuple[Twin, MeasurementModel]:
    """Printer and measurement fitted to the same scans, one after the other and once more.

    Args:
        twin: where the fit of the printer begins; ``scans``: as they are, freed of nothing.
        fold: that a base which was trained without each fold must not have seen.
        refit: the printer, once the measurement is known; or leave it where it is.
    """
    stored = [scan.stored for scan in scans]
    placed = twin.placed()
    maps = [placed.height(scan, fold) for scan in scans]
    learned = learn_measurement(stored, maps, seed=seed)
    if refit and len(twin.vector):
        freed = [learned.freed(scan, own) for scan, own in zip(stored, maps, strict=True)]
        windows = [scan.window for scan in prepared_among(freed, scans)]
        twin = twin.at(fit_least_squares(TwinProblem(twin, windows, fold), twin.vector, RULES).vector)
        placed = twin.placed()
        learned = learn_measurement(stored, [placed.height(scan, fold) for scan in scans], seed=seed)
    return twin, learned


def _rests(stages: dict[str, State], study: Study, learner: Learner) -> dict[str, Rest]:
    """What could still be learned beside each stage that changes the model."""
    rests: dict[str, Rest] = {}
    seen: list[State] = []
    for name, state in stages.items():
        if any(state is other for other in seen):
            continue
        seen.append(state)
        rests[name] = learner.rest(held_out_maps(state, study, study.scans))
    return rests
