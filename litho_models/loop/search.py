"""Search for the effects that a model lacks. Effects are added one at a time, as long as they reduce the
error on held-out scans. At the end, every added effect is tested again.

Before each addition, all candidates are screened at once, both with strengths that are the same in all scans
and with strengths that differ by group. The most promising candidates are then fitted in full before one of
them is chosen. This is necessary because screening assumes that the change an effect makes is proportional to
its strength, which gives only a rough estimate of the gain of a large effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from litho_models.effects import Effect, get_effect, screened_effects
from litho_models.effects.effect import Role
from litho_models.loop.fits import State, Study, fit_state
from litho_models.loop.judging import Judgement, judge, judge_states, told_apart
from litho_models.loop.screening import Screened, Screening, Secants
from litho_models.scan_terms.grouped import ALL

# Two effects count as indistinguishable if the cosine between the changes that they make to the predictions
# is at least this large.
SAME_COSINE = 0.8


@dataclass(frozen=True, eq=False)
class Cause:
    """An effect that a search has added to the model: a cause, a law or a table.

    Attributes:
        name: name of the effect.
        by: ``all`` if the strength is the same in all scans, and otherwise the name of the grouping with one
            strength per group.
        alike: other effects that look the same in these scans.
        judgement: the gain on held-out scans when the effect is added to the model with all other effects,
            and the test of this gain.
        family_p: p value of the effect in the screening of all candidates.
        group_p: p value of the grouping; None if the strength does not differ by group.
        reason: reason why the effect was rejected as the cause; empty if it was not rejected.
        corrects: whether the effect was rejected because it may merely correct the formula of another effect.
        survives_on: names of the other base models that also need this effect beside all others.
        excluded: effects that look the same in these scans but were excluded by later prints.
        role: role of the effect (``process`` or ``measurement``, for example), if later prints decided it;
            otherwise None.
    """

    name: str
    by: str
    alike: tuple[str, ...]
    judgement: Judgement
    family_p: float
    group_p: float | None
    reason: str = ""
    corrects: bool = False
    survives_on: tuple[str, ...] = ()
    excluded: tuple[str, ...] = ()
    role: Role | None = None


@dataclass
class Found:
    """The result of a search.

    Attributes:
        state: the model with the effects that were added.
        causes: the effects that were added.
        first, last: the first and the last screening result of each candidate, keyed by the name of the
            candidate.
        refused: reasons why candidates were rejected, keyed by the name of the candidate.
        failed: effects that were added at first and later rejected as causes.
    """

    state: State
    causes: list[Cause] = field(default_factory=list)
    first: dict[str, Screened] = field(default_factory=dict)
    last: dict[str, Screened] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    failed: list[Cause] = field(default_factory=list)


def search(
    found: Found, candidates: Sequence[Effect], most: int = 8, secants: Sequence[Secants] | None = None
) -> Found:
    """Add effects to a fitted model as long as held-out scans confirm them.

    Args:
        found: the fitted model. If it already contains effects that an earlier search has added, these are
            first tested again. It is changed in place.
        candidates: effects that may be added.
        most: largest number of effects in the result.
        secants: for each window, the changes that the candidates make to the prediction of a similar model.
            If they are given, they are used as approximations, and the changes of the predictions of the
            current model are not computed.
    """
    _test_again(found)
    while len(found.causes) < most and _add_one(found, candidates, secants):
        pass
    if len(found.causes) > 1:
        _test_again(found)
    return found


def describe(
    state: State, tables: Sequence[Effect], most: int, secants: Sequence[Secants] | None = None
) -> list[Screened]:
    """Return the tables that held-out scans confirm as an improvement of a model. Each table is judged alone,
    by a linear fit, and is not added to the model. At most ``most`` tables are judged.
    """
    return [
        one
        for one in Screening(state, tables, secants).standing()[:most]
        if not judge(state.freed_nm2, state.freed_nm2 - one.gains_nm2, state.study).reason(one.by)
    ]


def with_effect(state: State, one: Screened, *, from_here: bool = False) -> State:
    """Add an effect to a model, and refit all parameters of the model. ``from_here`` is as for
    ``fit_state``.
    """
    return fit_state(state.twin.with_effect(one.name, one.by, one.start()), state.study, from_here=from_here)


def _add_one(found: Found, candidates: Sequence[Effect], secants: Sequence[Secants] | None) -> bool:
    study = found.state.study
    effects = [one for one in candidates if one.name not in found.state.twin.names]
    if not effects:
        return False
    screening = Screening(found.state, effects, secants)
    found.first, found.last = screening.common | found.first, found.last | screening.common
    left = screening.standing()
    study.report(f"{len(left)} of {len(effects)} candidates are significant")
    while left:
        best = left[0]
        # Up to three candidates that make a similar change are fitted together with the best candidate.
        near = (one for one in left[1:] if one.gain_nm2 >= 0.3 * best.gain_nm2)
        entering = [best, *(one for one in near if abs(screening.cosine(best, one)) >= 0.5)][:4]
        left = [one for one in left if one not in entering]
        fitted = {}
        for one in entering:
            study.report(f"fitting {one.name}")
            # Laws are searched for last, so the parameters of the base are close to their final values.
            fitted[one.name] = with_effect(found.state, one, from_here=secants is not None)
        for one in sorted(entering, key=lambda one: fitted[one.name].mse_nm2):
            judgement = judge_states(found.state, fitted[one.name])
            if refused := judgement.reason(one.by):
                found.refused[one.name] = refused
                continue
            alike = _alike(one, fitted, found.state, screening)
            found.causes.append(Cause(one.name, one.by, alike, judgement, one.family_p, one.group_p))
            found.state = fitted[one.name]
            found.refused.pop(one.name, None)
            gained = f"{judgement.gain_nm2:.0f} of {judgement.before_nm2:.0f} nm² on held-out scans"
            study.report(f"adding {one.name}{'' if one.by == ALL else ' by ' + one.by}: it removes {gained}")
            return True
    return False


def _alike(
    one: Screened, fitted: Mapping[str, State], before: State, screening: Screening
) -> tuple[str, ...]:
    """Return the names of the other effects that look the same as this effect in the scans. Effects that were
    fitted are compared by their fits, and all other effects by the results of screening.
    """
    own = fitted[one.name]
    by_fit = [
        name
        for name, other in sorted(fitted.items(), key=lambda pair: pair[1].mse_nm2)
        if name != one.name and same_change(before, own, other) and not told_apart(before, own, other)
    ]
    by_screening = [
        other.name
        for other in sorted(screening.candidates, key=lambda other: -other.gain_nm2)
        if other.by == one.by
        and other.name not in fitted
        and other.allowed
        and other.gain_nm2 >= 0.5 * one.gain_nm2
        and abs(screening.cosine(one, other)) >= SAME_COSINE
    ]
    return (*by_fit, *by_screening)


def same_change(before: State, one: State, other: State) -> bool:
    """Return whether two changes of a model have nearly the same effect on the predictions of held-out scans.

    Args:
        before: the model before the change.
        one, other: the model after the first change, and the model after the second change.
    """

    def change(after: State) -> np.ndarray:
        parts = map(np.subtract, before.held_out_um, after.held_out_um)
        return np.concatenate([part - part.mean() for part in parts])

    a, b = change(one), change(other)
    return bool(a @ b > SAME_COSINE * np.linalg.norm(a) * np.linalg.norm(b))


def _test_again(found: Found) -> None:
    """Judge the gain of each cause in the model with all other causes, and remove each cause that held-out
    scans do not confirm.
    """
    kept = []
    for cause in found.causes:
        found.state.study.report(f"testing {cause.name} again")
        without = found.state.without(cause.name)
        judgement = judge_states(without, found.state)
        if judgement.reason(cause.by):
            found.refused[cause.name] = "not needed after the other effects were added"
            found.state = without
        else:
            kept.append(replace(cause, judgement=judgement))
    found.causes = kept


def untestable(study: Study) -> dict[str, str]:
    """Return the effects that cannot be tested with these scans, each with the reason."""
    reasons = {}
    positions = len({scan.context.order for scan in study.scans})
    one_level = all(np.ptp(scan.mask_level) == 0 for scan in study.scans)
    for effect in screened_effects():
        if one_level:
            reasons[effect.name] = "every layout has only one level, so nothing in the print varies"
        elif "order" in effect.needs and positions < 3:
            reasons[effect.name] = (
                "the writing order of the scans is not known"
                if positions == 1
                else "the scans have only two positions in the writing order"
            )
        elif "probe" in effect.needs and study.scans[0].seen_by == "confocal":
            reasons[effect.name] = "a confocal microscope has no probe"
    return reasons


def separating(names: Sequence[str]) -> str:
    """Return the experiments that would distinguish the named effects, in words."""
    return "; ".join(filter(None, dict.fromkeys(get_effect(name).separating for name in names)))
