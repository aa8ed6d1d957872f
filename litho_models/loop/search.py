"""The joint search: causes are added while they gain on held-out scans, and each defends its place.

All candidates are screened at once, with strengths for all scans and by group. Those that promise about as
much as the best are fitted in full beside each other before one is taken, because a derivative at the null
only guesses what a large effect does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from litho_data.sharing.workers import run_jobs
from litho_models.effects import CATALOGUE, Effect, get_effect
from litho_models.loop.fits import State, Study, fit_state
from litho_models.loop.judging import (
    EXCHANGED_P,
    FAMILY_P,
    GROUPED_P,
    SMALLEST_SHARE,
    Judgement,
    judge,
    told_apart,
)
from litho_models.loop.regrouping import best_grouping, regrouped
from litho_models.loop.screening import SMALLEST_RETAINED, Screened, Screening
from litho_models.loop.trials import Secants
from litho_models.scan_terms.grouped import ALL

# Of the smallest gain that counts: a derivative at the null predicts the gain of a fit to a factor of three.
WORTH_FITTING = 0.3
# What changes the held-out prediction so alike cannot be told apart by its shape.
SAME_COSINE = 0.8


@dataclass(frozen=True)
class Cause:
    """An effect in the model.

    Attributes:
        name, by: the effect, and the grouping of its strength.
        alike: other effects that these scans cannot tell from it.
        judgement: of its gain on held-out scans, the rest of the model in place.
        family_p: of its screening, over all candidates; ``group_p``: of its grouping, by exchanged labels.
        values: of its parameters by label, from which a table is fitted.
    """

    name: str
    by: str
    alike: tuple[str, ...]
    judgement: Judgement
    family_p: float
    group_p: float | None
    values: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


@dataclass
class Found:
    """What a search found: the model, its causes, and what is known of every other candidate."""

    state: State
    causes: list[Cause] = field(default_factory=list)
    first: dict[str, Screened] = field(default_factory=dict)
    last: dict[str, Screened] = field(default_factory=dict)
    family_p: dict[str, float] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        return [cause.name for cause in self.causes]

    def screened(self, name: str) -> Screened | None:
        """What was last known of a candidate; None if it never was one."""
        return self.last.get(name) or self.first.get(name)


def search(
    start: State,
    study: Study,
    candidates: Sequence[Effect],
    most: int = 8,
    secants: Secants | None = None,
) -> Found:
    """Add effects to a fitted model, at most so many.

    Args:
        start: the model so far; ``study``: scans, folds and groups; ``candidates``: what may be added.
        secants: of the candidates at a model like this one; by default at the model itself.
    """
    found = Found(start)
    while len(found.causes) < most and _add_one(found, study, candidates, secants):
        pass
    _defend(found, study)
    return found


def describe(
    state: State, study: Study, tables: Sequence[Effect], most: int, secants: Secants | None = None
) -> list[Cause]:
    """Tables that stand out beside a model, each as a linear fit beside it alone."""
    screening, found = Screening(state, study, tables, secants), []
    for one in _standing(screening, Found(state))[:most]:
        judgement = judge(state.freed_nm2, state.freed_nm2 - one.gains_nm2, study)
        if judgement.passed(grouped=one.by != ALL):
            found.append(replace(_cause(one, (), judgement, screening), values=one.start()))
    return found


def _cause(one: Screened, alike: tuple[str, ...], judgement: Judgement, screening: Screening) -> Cause:
    group_p = None if one.by == ALL else screening.permutation_p(one)
    return Cause(one.name, one.by, alike, judgement, screening.family_p(one), group_p)


def _add_one(found: Found, study: Study, candidates: Sequence[Effect], secants: Secants | None) -> bool:
    effects = [one for one in candidates if one.name not in found.state.twin.names]
    if not effects:
        return False
    screening = Screening(found.state, study, effects, secants)
    standing = _standing(screening, found)
    study.report(f"{len(standing)} of {len(effects)} candidates stand out")
    tried: set[str] = set()
    for best in standing:
        if best.name in tried:
            continue
        entering = [best, *_rivals(best, [one for one in standing if one.name not in tried], screening)]
        fitted = _fitted(found.state, entering, study)
        for one in sorted(entering, key=lambda one: fitted[one.name].mse_nm2):
            tried.add(one.name)
            judgement = judge(found.state.freed_nm2, fitted[one.name].freed_nm2, study)
            if refused := judgement.reason(grouped=one.by != ALL):
                found.refused[one.name] = refused
                continue
            alike = _alike(one, fitted, found.state, screening, study)
            found.causes.append(_cause(one, alike, judgement, screening))
            found.state = fitted[one.name]
            found.refused.pop(one.name, None)
            if one.by == ALL:
                _regroup(found, study)
            gained = f"{judgement.gain_nm2:.0f} nm² of {judgement.before_nm2:.0f} nm² on held-out scans"
            study.report(f"adding {one.name}{'' if one.by == ALL else ' by ' + one.by}: {gained}")
            return True
    return False


def _regroup(found: Found, study: Study) -> None:
    """Let the strength of the cause that was just added differ by group, if that is confirmed."""
    cause = found.causes[-1]
    other = regrouped(found.state, cause.name, study)
    if other is None:
        return
    by, p, twin = other
    state = fit_state(twin, study, from_here=True)
    if judge(found.state.freed_nm2, state.freed_nm2, study).p <= GROUPED_P:
        study.report(f"{cause.name} differs by {by}")
        found.causes[-1] = replace(cause, by=by, group_p=p)
        found.state = state


def _rivals(best: Screened, standing: Sequence[Screened], screening: Screening) -> list[Screened]:
    """The three that promise most beside the best, a third of its gain or more, and change much the same."""
    return [
        one
        for one in standing
        if one is not best and one.gain_nm2 >= 0.3 * best.gain_nm2 and abs(screening.cosine(best, one)) >= 0.5
    ][:3]


def _alike(
    one: Screened, fitted: Mapping[str, State], before: State, screening: Screening, study: Study
) -> tuple[str, ...]:
    """What these scans cannot tell from it: by fits where there are, by what is screened elsewhere."""
    own = fitted[one.name]
    by_fit = [
        name
        for name, other in sorted(fitted.items(), key=lambda pair: pair[1].mse_nm2)
        if name != one.name
        and same_change(before, own, other)
        and not told_apart(before.freed_nm2, own.freed_nm2, other.freed_nm2, study)
    ]
    by_screening = [
        other.name
        for other in screening.candidates
        if other.by == one.by
        and other.name not in fitted
        and other.allowed
        and other.gain_nm2 >= 0.5 * one.gain_nm2
        and abs(screening.cosine(one, other)) >= SAME_COSINE
    ]
    return (*by_fit, *by_screening)


def _standing(screening: Screening, found: Found) -> list[Screened]:
    """The candidates that stand out, each with the grouping that its scans ask for, by gain."""
    by_name: dict[str, list[Screened]] = {}
    for one in screening.candidates:
        by_name.setdefault(one.name, []).append(one)
    mse = found.state.mse_nm2
    worth = WORTH_FITTING * SMALLEST_SHARE * mse
    standing = []
    for name, own in by_name.items():
        common = next(one for one in own if one.by == ALL)
        found.first.setdefault(name, common)
        found.last[name] = common
        found.family_p.setdefault(name, screening.family_p(common))
        chosen = _grouped(own, common, screening, mse) or common
        if not chosen.allowed or chosen.retained < SMALLEST_RETAINED or chosen.gain_nm2 < worth:
            continue
        if chosen is common and screening.family_p(common) > FAMILY_P:
            continue
        standing.append(chosen)
    return sorted(standing, key=lambda one: -one.gain_nm2)


def _grouped(
    own: Sequence[Screened], common: Screened, screening: Screening, mse_nm2: float
) -> Screened | None:
    """The grouping of an effect's strength that gains beyond chance over one strength for all, or None."""
    least = max(common.gain_nm2, 0.0) + SMALLEST_SHARE * mse_nm2
    better = {one.by: one for one in own if one.by != ALL and one.allowed and one.gain_nm2 > least}
    by = best_grouping(
        {by: one.gain_nm2 for by, one in better.items()}, {by: one.numbers for by, one in better.items()}
    )
    return None if by is None or screening.permutation_p(better[by]) > EXCHANGED_P else better[by]


def _fitted(state: State, entering: Sequence[Screened], study: Study) -> dict[str, State]:
    jobs = [(one.name, state.twin.with_effect(one.name, one.by, one.start()), study) for one in entering]
    return {name: own for (name, *_), own in run_jobs(_fit, jobs, study.workers, name=lambda job: job[0])}


def _fit(job: tuple[str, object, Study]) -> State:
    name, twin, study = job
    study.report(f"fitting {name}")
    return fit_state(twin, study)  # type: ignore[arg-type]


def same_change(before: State, one: State, other: State) -> bool:
    """Whether two states change the held-out prediction alike."""
    inner = np.zeros((2, 2))
    for old, a, b in zip(before.held_out_um, one.held_out_um, other.held_out_um, strict=True):
        changes = np.stack([old - a, old - b])
        changes -= changes.mean(axis=1, keepdims=True)
        inner += changes @ changes.T
    return bool(inner[0, 1] / max(np.sqrt(inner[0, 0] * inner[1, 1]), 1e-300) >= SAME_COSINE)


def _defend(found: Found, study: Study) -> None:
    """Each cause is taken out, the rest fitted again: what is not confirmed with all others in place goes."""
    if len(found.causes) < 2:
        return
    for cause in list(found.causes):
        study.report(f"deciding once more on {cause.name}")
        without = found.state.without(cause.name, study)
        judgement = judge(without.freed_nm2, found.state.freed_nm2, study)
        at = found.causes.index(cause)
        if judgement.passed(grouped=cause.by != ALL):
            found.causes[at] = replace(cause, judgement=judgement)
        else:
            found.causes.pop(at)
            found.refused[cause.name] = "not needed once the others were added"
            found.state = without


def untestable(study: Study) -> dict[str, str]:
    """Effects that these scans cannot test, with the reason."""
    reasons = {}
    one_level = all(np.ptp(scan.stored.mask_level) == 0 for scan in study.scans)
    for effect in CATALOGUE.values():
        if effect.per_scan:
            continue
        if one_level:
            reasons[effect.name] = "every layout has one level only: nothing in the print varies with it"
        elif "order" in effect.needs and len({scan.context.order for scan in study.scans}) < 3:
            reasons[effect.name] = "the writing order of the scans is not known"
    return reasons


def separating(names: Sequence[str]) -> str:
    """What would tell the members of a set apart."""
    texts = dict.fromkeys(get_effect(name).separating for name in names)
    return "; ".join(text for text in texts if text)
