"""Close the loop on a set of scans: from the residual of a base to causes, laws and what is left.

Bases compete by what they explain together with causes: causes are sought beside each of them.

``close`` is an estimator: it chooses and fits on the scans that it is given, and what it returns predicts any
other scan. Whatever is judged on scans is chosen without them by calling it on the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

from torch import nn

from litho_models.effects import screened_effects
from litho_models.effects.laws import LAWS, TABLES
from litho_models.loop.checking import Check
from litho_models.loop.fits import State, Study, fit_state
from litho_models.loop.judging import SMALLEST_SHARE, judge
from litho_models.loop.learner import Learner, Rest
from litho_models.loop.measured import freed_scans
from litho_models.loop.model import Twin
from litho_models.loop.prepared import prepare_scans
from litho_models.loop.search import Cause, Found, describe, search, untestable, with_table
from litho_models.loop.trials import Secants
from litho_models.scan_terms.grouped import ALL


@dataclass(frozen=True)
class Closed:
    """What was chosen and fitted on some scans.

    Attributes:
        base_name: of the base that was taken; ``rivals``: what the same search found beside the others.
        plain: the base fitted to the scans as they are; ``base``: to scans freed of what a group shares.
        named: among causes; ``lawful``: among short laws beside them.
        described: tables over a covariate, which say where the rest lies; the model has them last.
        rests: what features of layout and place still explain, by stage.
        untestable: effects that could not be tested, with the reason.
    """

    base_name: str
    rivals: Mapping[str, Found]
    plain: State
    base: State
    named: Found
    lawful: Found
    described: Found
    rests: dict[str, Rest]
    untestable: dict[str, str]

    @property
    def given(self) -> Study:
        """The scans as they are."""
        return self.plain.study

    @property
    def study(self) -> Study:
        """The freed scans."""
        return self.base.study

    @property
    def final(self) -> State:
        """The corrected model: causes, laws, and tables where neither holds."""
        return self.described.state

    @property
    def traced(self) -> list[Cause]:
        """Causes and laws."""
        return [*self.named.causes, *self.lawful.causes]

    @property
    def found(self) -> list[Cause]:
        """All that is reported."""
        return [*self.traced, *self.described.causes]

    def survives_on(self, cause: Cause) -> list[str]:
        """The other bases beside which the search found the same cause, or one of its set."""
        alike = {cause.name, *cause.alike}
        return [
            name
            for name, rival in self.rivals.items()
            if any(alike & {one.name, *one.alike} for one in rival.causes)
        ]

    def needed_by_all(self, cause: Cause) -> bool:
        """Whether every other base lacks the cause too; one with more numbers may have taken it up."""
        base, survives_on = self.plain.twin.own, self.survives_on(cause)
        others = {name for name, rival in self.rivals.items() if rival.state.twin.own <= base}
        return others <= {*survives_on}


def close(study: Study, bases: Mapping[str, nn.Module]) -> Closed:
    """Find what a base lacks on these scans.

    Args:
        study: development scans.
        bases: simulators by name, those with few parameters refitted, others taken as they are.
    """
    plain = {}
    for name, base in bases.items():
        study.report(f"fitting {name} to {len(study.scans)} scans")
        plain[name] = fit_state(Twin.bare(base), study)
    study.report("learning what scans of a group share")
    nearest = min(plain.values(), key=lambda state: state.mse_nm2)
    freed = replace(study, scans=prepare_scans(freed_scans(nearest)))
    excluded = untestable(freed)
    candidates = [
        one
        for one in screened_effects(freed.tip_radius_um)
        if one.name not in excluded and one.of_films == freed.of_films
    ]
    starts = {name: fit_state(state.twin, freed) for name, state in plain.items()}
    searches = {}
    for name, state in starts.items():
        study.report(f"looking for what {name} lacks")
        searches[name] = search(state, candidates)
    chosen = _simplest(searches)
    start, named = starts[chosen], searches.pop(chosen)
    learner = Learner(freed, start.maps_um(freed.scans))

    @cache
    def rest(state: State) -> Rest:
        return learner.rest(state.maps_um(freed.scans))

    lawful, described = _checked(start, named, rest)
    stages: dict[State, str] = {}
    for name, state in (
        ("base", start), ("causes", named.state), ("laws", lawful.state), ("tables", described.state)
    ):  # fmt: skip
        # By the model, so that a stage that changes nothing counts with the one before it.
        stages.setdefault(state, name)
    return Closed(
        base_name=chosen,
        rivals=searches,
        plain=plain[chosen],
        base=start,
        named=named,
        lawful=lawful,
        described=described,
        rests={name: rest(state) for state, name in stages.items()},
        untestable=excluded,
    )


def _simplest(searches: Mapping[str, Found]) -> str:
    """The base that needs the fewest numbers, causes included, of those that do as well as the best."""
    best_nm2 = min(found.state.mse_nm2 for found in searches.values())
    close = {
        name: len(found.state.twin.vector)
        for name, found in searches.items()
        if found.state.mse_nm2 <= (1 + 2 * SMALLEST_SHARE) * best_nm2
    }
    return min(close, key=lambda name: close[name])


def _checked(start: State, named: Found, rest: Callable[[State], Rest]) -> tuple[Found, Found]:
    """Laws beside the causes, and tables beside both; each cause is checked with everything else in place.

    One that fails is taken out, and laws are sought anew without it.

    Args:
        start: the base; ``named``: its causes, of which those remain whose names stand.
    """
    study = start.study
    # Laws and tables are of heights.
    laws, tables = ([], []) if study.of_films else (list(LAWS.values()), list(TABLES.values()))
    secants = Secants(start.twin, study.windows)
    while True:
        study.report("looking for a law in what is left")
        lawful = search(named.state, laws, 4, secants)
        study.report("describing what is left")
        described = describe(lawful.state, tables, 2, secants)
        if named.causes:
            in_place = _with_larger_table(lawful.state, described, start.mse_nm2 - named.state.mse_nm2)
            others = [*named.causes, *lawful.causes]
            check = Check(in_place, others, laws, tables, rest(in_place).mean_nm2, secants)
            named.causes = [check.of(cause) for cause in named.causes]
            if not any(one.reason for one in named.causes):
                named.causes = [check.beside_table(check.beside_laws(one)) for one in named.causes]
        wrong = sorted((one for one in named.causes if one.reason), key=lambda one: one.judgement.gain_nm2)
        if not wrong:
            return lawful, _in_model(lawful.state, described)
        # What may only correct another formula goes first: that formula is then judged without it.
        for one in [one for one in wrong if one.corrects] or wrong[:1]:
            study.report(f"{one.name}: {one.reason}")
            named.refused[one.name] = one.reason
            named.failed.append(one)
            named.causes.remove(one)
            named.state = named.state.without(one.name) if named.causes else start


def _in_model(state: State, described: Sequence[Cause]) -> Found:
    """The model with every table that is confirmed there too, fitted beside all the rest."""
    found = Found(state)
    for table in described:
        fitted = with_table(found.state, table)
        judgement = judge(found.state.freed_nm2, fitted.freed_nm2, state.study)
        if judgement.passed(grouped=table.by != ALL):
            found.state = fitted
            found.causes.append(replace(table, judgement=judgement))
    return found


def _with_larger_table(state: State, described: Sequence[Cause], named_nm2: float) -> State:
    """The model, with the largest table beside it if that takes more than all causes together.

    A table follows whatever it can. It is held against all causes, not against single ones.
    """
    table = max(described, key=lambda one: one.judgement.gain_nm2, default=None)
    if table is None or table.judgement.gain_nm2 <= named_nm2:
        return state
    return with_table(state, table)
