"""Forward selection of effects: contests one after another, then one pass over what was taken."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

from litho_models.effects import get_effect, screened_effects
from litho_models.loop.screening.score_test import Screened
from litho_models.loop.selection.contest import Added, Contest, hold_contest
from litho_models.loop.selection.rivals import generic_rival, remainder_of
from litho_models.loop.study import State, Study, fit_state
from litho_models.scan_terms import Terms

MOST_EFFECTS = 8
# Of the amplitude of an effect: as well as a formula of the catalogue can be trusted.
FORM_ERROR = 0.1


@dataclass
class Search:
    """What the selection found.

    ``steps``: effect to the model without and with it, when it was added.
    ``first``, ``last``: first and latest screening of every candidate.
    ``failures``: effect to why it was not confirmed.
    ``dropped``: added and not needed later; ``absorbed``: only the small model lacks it.
    """

    state: State
    added: list[Added] = field(default_factory=list)
    steps: dict[str, tuple[State, State]] = field(default_factory=dict)
    first: dict[str, Screened] = field(default_factory=dict)
    last: dict[str, Screened] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    dropped: dict[str, str] = field(default_factory=dict)
    absorbed: dict[str, str] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        return [entry.effect.name for entry in self.added]

    def add(self, added: Added, state: State, *, before: State) -> None:
        """Take a winner into the model."""
        self.added.append(added)
        self.steps[added.effect.name] = (before, state)
        self.state = state

    def note(self, contest: Contest) -> None:
        """Keep the screenings of a contest, and why candidates were not confirmed."""
        self.last = {s.effect.name: s for s in contest.screened}
        for s in contest.screened:
            self.first.setdefault(s.effect.name, s)
        self.failures |= contest.failures
        if contest.winner is not None:
            self.failures.pop(contest.winner[0].effect.name, None)


def search_effects(start: State, study: Study, terms: Terms, *, exclude: Mapping[str, str]) -> Search:
    """Add effects one at a time while one is confirmed and no generic term does the same, and better.

    Args:
        start: the base model.
        terms: scan terms of the scoring.
        exclude: effects that cannot be tested here, with the reason.
    """
    found = Search(start)

    def contest(
        state: State, holder: tuple[str, State] | None = None, refused: Collection[str] = ()
    ) -> Contest:
        effects = screened_effects(study.tip_radius_um)
        candidates = [one for one in effects if one.name not in {*exclude, *state.fits.chain.names}]
        return hold_contest(state, candidates, study, terms, holder=holder, refused=refused)

    def select() -> bool:
        """Add winners while they earn a name; whether the last ones were refused."""
        refused: dict[str, float] = {}
        while len(found.added) < MOST_EFFECTS:
            held = contest(found.state, refused=refused)
            found.note(held)
            if held.winner is None:
                return bool(refused)
            name = held.winner[0].effect.name
            gain_nm2 = _gain_nm2(found.state, held.winner[1], study, terms)
            if gain_nm2 < max(refused.values(), default=0.0):
                # Smaller effects cannot be named while the largest part of what is missing has no name.
                found.failures[name] = "gains less than another that got no name"
                return True
            if rejected := rejection_reason(held.winner, found.state, found, study):
                found.failures[name] = rejected
                refused[name] = gain_nm2
                continue
            found.add(*held.winner, before=found.state)
            for other in refused:
                found.failures.pop(other)
            refused.clear()
        return False

    refused = select()
    chosen = found.names
    for entry in list(found.added[:-1]):
        study.report(f"deciding once more on {entry.effect.name}")
        _decide_again(found, entry, contest, study)
    if refused and found.names != chosen:
        # What it was refused for may be gone.
        select()
    return found


def _gain_nm2(before: State, after: State, study: Study, terms: Terms) -> float:
    """Mean gain in squared error on scans left out, by the terms that all candidates are compared with."""
    return float((before.score(study, terms).mse_nm2 - after.score(study, terms).mse_nm2).mean())


def rejection_reason(winner: tuple[Added, State], before: State, found: Search, study: Study) -> str:
    """Why a winner gets no name: a generic term, or a correction of an earlier formula, does as much."""
    added, state = winner
    for earlier in found.added:
        name = earlier.effect.name
        if name not in before.fits.chain.names:
            continue
        if added.gain_nm2 < FORM_ERROR**2 * earlier.gain_nm2:
            return f"small beside {name}, whose formula may be wrong by {100 * FORM_ERROR:.0f} %"
        if reason := remainder_of(found.steps[name], before, state, study):
            return reason.format(name)
    rival = generic_rival(before, state, study)
    return f"{rival} does the same, and better, without a name" if rival else ""


def _decide_again(
    found: Search,
    entry: Added,
    contest: Callable[..., Contest],
    study: Study,
) -> None:
    """An effect was chosen before those that came later: with them in place it defends its place."""
    name, chain = entry.effect.name, found.state.fits.chain
    kept = {other: values for other, values in chain.values().items() if other != name}
    without = fit_state(chain.with_effects(kept), study)
    held = contest(without, (name, found.state))
    if held.winner is None:
        found.added.remove(entry)
        found.dropped[name] = f"not needed once the others were added: {held.failures.get(name, '')}"
        found.state = without
        return
    added, _ = held.winner
    if added.effect.name == name:
        # Where it stands in the order stays; with what it can be confused is known better now.
        found.added[found.added.index(entry)] = replace(entry, confusable_with=added.confusable_with)
        return
    if rejection_reason(held.winner, without, found, study):
        return
    found.dropped[name] = f"{added.effect.name} does better once the others were added"
    found.added.remove(entry)
    found.add(*held.winner, before=without)


class EffectSets:
    """The model with some of the effects of a search, fitted where the search has not done it.

    Args:
        found: what was selected; ``base``: the model without any effect; ``study``: the scans of both.
    """

    def __init__(self, found: Search, base: State, study: Study):
        self._found = found
        self._study = study
        self._known = {frozenset(s.fits.chain.names): s for pair in found.steps.values() for s in pair}
        self._known |= {frozenset(): base, frozenset(found.names): found.state}

    def state(self, names: Sequence[str]) -> State:
        """The model with these effects."""
        wanted = frozenset(names)
        if wanted not in self._known:
            chain = self._found.state.fits.chain
            values = {name: own for name, own in chain.values().items() if name in wanted}
            self._known[wanted] = fit_state(chain.with_effects(values), self._study)
        return self._known[wanted]

    def without(self, name: str) -> State:
        """The final set without one of its effects."""
        return self.state([other for other in self._found.names if other != name])


def separating_experiment(names: Sequence[str]) -> str:
    """What would tell the members of a set apart."""
    experiments = dict.fromkeys(get_effect(name).separating for name in names)
    return "; ".join(text for text in experiments if text)
