"""Apply the decisions of later prints to the result of a loop: replace or confirm its causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

from litho_models.effects import get_effect
from litho_models.effects.effect import Role
from litho_models.loop.closing import Closed
from litho_models.loop.fits import State, fit_state
from litho_models.loop.judging import judge_states
from litho_models.loop.record import Decision
from litho_models.loop.search import Cause, Found
from litho_models.planning.questions import NONE, OpenQuestions, Owner
from litho_models.scan_terms.grouped import ALL

_ROLES: dict[Owner | None, Role] = {"printer": "process", "microscope": "measurement"}


def with_decisions(closed: Closed, open_: OpenQuestions, decisions: Sequence[Decision]) -> Closed:
    """Return the result of the loop with the causes that remain possible after the decisions. If new prints
    exclude a cause, it is replaced by an effect that remains possible. If only one answer remains, its effect
    is named as the cause. The role of this effect is ``process`` if the answer states that the printer causes
    it, ``measurement`` if the answer states the microscope, and otherwise the role in the catalogue.
    """
    rivals_of = {one.name: one.rivals for one in open_.questions}
    for decision in decisions:
        name, rivals = decision.question, rivals_of[decision.question]
        left = [one for one in rivals if one.name in decision.left]
        cause = next((one for one in closed.traced if one.name == name), None)
        if not left or decision.verdict == NONE or (cause is None and len(left) > 1):
            continue
        # If the cause itself remains possible, it is kept.
        best = min(left, key=lambda one: one.effect != name)
        if best.effect != name and best.effect in closed.final.twin.names:
            continue
        remain = {one.effect for one in left}
        excluded = dict.fromkeys(one.effect for one in rivals if one.effect not in remain)
        role, alike = None, (name, *cause.alike) if cause else ()
        if len(left) == 1:
            role, alike = _ROLES.get(best.owner, get_effect(best.effect).role), ()
        closed = _with_answer(
            closed,
            cause,
            best.effect,
            best.effects[best.effect],
            alike=tuple(one for one in alike if one not in {best.effect, *excluded}),
            excluded=tuple(excluded),
            role=role,
        )
    return closed


def _with_answer(
    closed: Closed, cause: Cause | None, name: str, values: Mapping[str, float], **known: Any
) -> Closed:
    """Replace a cause or law in the result of a loop by the effect that is still possible after later prints,
    and return the new result. Each model that contained the cause is fitted again with the effect instead of
    the cause.

    Args:
        closed: the result.
        cause: the cause or law to replace, or None if the effect is added as a further cause.
        name: name of the effect. It may be the name of the cause itself.
        values: starting values of the parameters of the effect.
        known: the fields ``alike``, ``excluded`` and ``role`` of the new `Cause`.
    """
    same = cause is not None and cause.name == name

    @cache
    def fitted(state: State) -> State:
        if same or (cause and cause.name not in state.twin.names):
            return state
        twin = state.twin.without(cause.name) if cause else state.twin
        return fit_state(twin.with_effect(name, ALL, {"": values}), state.study)

    if cause and same:
        answer = replace(cause, **known)
    else:
        final = fitted(closed.final)
        judgement = judge_states(final.without(name), final)
        family_p = {**closed.lawful.first, **closed.named.first}[name].family_p
        answer = Cause(name, ALL, judgement=judgement, family_p=family_p, group_p=None, **known)

    def replaced(found: Found) -> Found:
        causes = [answer if one is cause else one for one in found.causes]
        return replace(found, state=fitted(found.state), causes=causes)

    named, lawful, described = map(replaced, (closed.named, closed.lawful, closed.described))
    if cause is None:
        named.causes.append(answer)
    return replace(closed, named=named, lawful=lawful, described=described)
