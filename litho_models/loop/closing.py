"""Close the loop on a set of scans: find causes and laws in the residual of a base model.

The search is repeated with another base model if the model leaves something that can be explained and the
other base model fits better. The base models that were searched are then compared, each together with the
causes and laws that were found with it.

``close`` is an estimator: it uses only the given scans for all choices and fits, and its result can predict
any other scan. To judge its choices on held-out scans, call ``close`` without these scans.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

from torch import nn

from litho_models.effects import get_effect, screened_effects
from litho_models.effects.films import FILM_LAWS
from litho_models.effects.laws import LAWS, TABLES
from litho_models.loop.checking import Check
from litho_models.loop.fits import State, Study, fit_state
from litho_models.loop.judging import SMALLEST_SHARE, judge_states
from litho_models.loop.learner import Learner, Rest
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.record import Stage
from litho_models.loop.screening import Screened, Secants
from litho_models.loop.search import Cause, Found, describe, search, untestable, with_effect
from litho_models.scan_terms.measurement_fit import learn_measurement


@dataclass(frozen=True)
class Closed:
    """The result of a loop: all choices and fits that it made on the given scans.

    Attributes:
        base_name: name of the chosen base model.
        rivals: the other base models, fitted to the corrected scans, keyed by model name.
        plain: the chosen base model, fitted to the original scans.
        base: the chosen base model, fitted to the corrected scans (see ``study``).
        named: result of the search for causes, after all checks.
        lawful: result of the search for short laws. They are added to the model after the causes.
        described: result of the search for tables. They are added to the model after the causes and the laws.
            A table describes the remaining error as a function of one variable, such as level or position.
            Tables act after all other effects of the printer and before the effects of the microscope.
        rest: function that returns the part of a model's residual that can still be explained by features of
            layout and position.
        untestable: effects that could not be tested with these scans, each with the reason.
    """

    base_name: str
    rivals: Mapping[str, State]
    plain: State
    base: State
    named: Found
    lawful: Found
    described: Found
    rest: Callable[[State], Rest]
    untestable: dict[str, str]

    @property
    def given(self) -> Study:
        """Return the original scans."""
        return self.plain.study

    @property
    def study(self) -> Study:
        """Return the corrected scans: the scans minus the measurement errors that all scans of a group
        share.
        """
        return self.base.study

    @property
    def final(self) -> State:
        """Return the corrected model, with causes, laws and tables."""
        return self.described.state

    @property
    def ends(self) -> dict[Stage, State]:
        """Return the models at the start and at the end of the loop."""
        return {"base": self.base, "all": self.final}

    @cached_property
    def rests(self) -> dict[str, Rest]:
        """Return the part of the residual that can still be explained by features of layout and position. The
        result is keyed by the stage of the loop: ``base``, ``causes``, ``laws`` or ``tables``. A stage that
        did not change the model is left out.
        """
        # If a stage has the same model as the stage before it, it is replaced by the stage before it.
        stages = {
            self.final: "tables",
            self.lawful.state: "laws",
            self.named.state: "causes",
            self.base: "base",
        }
        return {stage: self.rest(state) for state, stage in reversed(stages.items())}

    @property
    def traced(self) -> list[Cause]:
        """Return the causes and the laws that were found."""
        return [*self.named.causes, *self.lawful.causes]

    def needed_by_all(self, cause: Cause) -> bool:
        """Return whether every other base model also needs the cause."""
        return {*self.rivals} <= {*cause.survives_on}


def close(study: Study, bases: Mapping[str, nn.Module]) -> Closed:
    """Use the scans to find the effects that a base model lacks. Return the chosen base model and all effects
    that were added to it.

    Args:
        study: the scans for development, with their folds.
        bases: base models, keyed by name, from which the loop chooses one. Base models with few parameters
            are refitted together with the effects.
    """
    plain = {}
    for name, base in bases.items():
        study.report(f"fitting {name} to {len(study.scans)} scans")
        plain[name] = fit_state(Twin.bare(base), study)
    study.report("fitting the measurement errors that groups of scans share")
    freed = replace(study, scans=freed_scans(min(plain.values(), key=lambda state: state.mse_nm2)))
    excluded = untestable(freed)
    tip_um = next((scan.tip_radius_um for scan in study.scans if scan.tip_radius_um is not None), None)
    candidates = [
        one for one in screened_effects(tip_um) if one.name not in excluded and one.of_films == freed.of_films
    ]
    starts = {name: fit_state(state.twin, freed) for name, state in plain.items()}
    rest = _rest_beside(next(iter(starts.values())))
    results: dict[str, tuple[Found, Found, Found]] = {}
    name = next(iter(starts))
    while name:
        study.report(f"searching for effects that {name} lacks")
        named = Found(starts[name])
        if results:
            # All base models probably lack the same causes, so each search starts from the causes that were
            # found with the first base model.
            first, _, _ = next(iter(results.values()))
            named = Found(first.state.on_base(starts[name]), [*first.causes], first.first)
        search(named, candidates)
        lawful, described = _checked(starts[name], named, rest)
        results[name] = named, lawful, described
        name = _next_base({one: own for one, own in starts.items() if one not in results}, lawful, rest)
    chosen = _simplest(results)
    start, (named, lawful, described) = starts.pop(chosen), results[chosen]
    for name, rival in starts.items():
        named.causes = _tested_on(name, rival, lawful.state, named.causes)
    return Closed(
        base_name=chosen,
        rivals=starts,
        plain=plain[chosen],
        base=start,
        named=named,
        lawful=lawful,
        described=described,
        rest=rest,
        untestable=excluded,
    )


def _rest_beside(start: State) -> Callable[[State], Rest]:
    """Return a function that computes the part of a model's residual that can still be explained by features
    of layout and position. ``start`` is the fitted base model.
    """
    scans = start.study.scans
    # The learner is made only when it is first needed. Loops that are repeated without a print seldom need
    # it.
    learner = cache(lambda: Learner(start.study, start.maps_um(scans)))
    return cache(lambda state: learner().rest(state.maps_um(scans)))


def freed_scans(state: State) -> list[PreparedScan]:
    """Subtract from each scan the measurement errors that all scans of its group have in common. Return the
    corrected scans.

    Errors that all scans of all groups share are not subtracted, so they can still be attributed to a cause.
    The errors to subtract from a scan are learned from the scans outside its fold.
    """
    study = state.study
    maps, scans, freed = state.maps_um(study.scans), study.scans, [*study.scans]
    for own, held_out in study.folds:
        if len(own) < 2:
            continue
        learned = learn_measurement([scans[i] for i in own], [maps[i] for i in own], seed=study.seed)
        differences = learned.between_groups()
        for i in held_out:
            freed[i] = differences.freed(scans[i], maps[i])
    return freed


def _next_base(left: Mapping[str, State], lawful: Found, rest: Callable[[State], Rest]) -> str:
    """Choose the base model with which the search is repeated: the one that fits best together with the
    causes and laws found so far. Return an empty text if the search ends, because the last model leaves
    nothing that can be explained, or because no other base model fits better with these effects.

    Args:
        left: the base models that have not been used yet, fitted without effects.
        lawful: result of the last search for laws.
        rest: function that returns the part of a model's residual that can still be explained.
    """
    if not left or not rest(lawful.state).matters:
        return ""
    mse_nm2 = {name: lawful.state.on_base(one).mse_nm2 for name, one in left.items()}
    best = min(mse_nm2, key=mse_nm2.__getitem__)
    return best if mse_nm2[best] < (1 - 2 * SMALLEST_SHARE) * lawful.state.mse_nm2 else ""


def _simplest(results: Mapping[str, tuple[Found, Found, Found]]) -> str:
    """Choose a base model. Of the models with nearly the smallest error, choose the one that has the fewest
    parameters together with its effects.

    Args:
        results: for each base model, the results of the searches for causes, laws and tables.
    """
    states = {name: lawful.state for name, (_, lawful, _) in results.items()}
    most_nm2 = (1 + 2 * SMALLEST_SHARE) * min(state.mse_nm2 for state in states.values())
    close = (name for name, state in states.items() if state.mse_nm2 <= most_nm2)
    return min(close, key=lambda name: len(states[name].twin.vector))


def _tested_on(name: str, rival: State, final: State, causes: list[Cause]) -> list[Cause]:
    """Fit another base model together with all effects that were found. Add its name to each cause whose gain
    held-out scans still confirm in this model.

    Args:
        name: name of the other base model.
        rival: the other base model, fitted without effects.
        final: the chosen base model with all causes and laws.
        causes: the causes.
    """
    if not causes:
        return causes
    study = rival.study
    study.report(f"testing the causes with {name}")
    state = final.on_base(rival)
    needed = (not judge_states(state.without(one.name), state).reason(one.by) for one in causes)
    return [
        replace(one, survives_on=(*one.survives_on, name)) if kept else one
        for one, kept in zip(causes, needed, strict=True)
    ]


def _checked(start: State, named: Found, rest: Callable[[State], Rest]) -> tuple[Found, Found]:
    """Search for laws that the model with the causes still lacks, and then for tables. Then check each cause
    in a model that also contains the laws. This model contains a table, too, if the table reduces the error
    more than all causes together.

    A cause that fails its check is removed, and the search for laws and tables is repeated without it. The
    repeated search starts from the laws that were found before. Return the result of the search for laws and
    the result of the search for tables.

    Args:
        start: the fitted base model.
        named: result of the search for causes with this base model. It is changed in place: causes that are
            rejected are removed.
        rest: function that returns the part of a model's residual that can still be explained.
    """
    study = start.study
    # Tables describe heights, not films.
    all_laws = (FILM_LAWS if study.of_films else LAWS).values()
    tables = [] if study.of_films else [*TABLES.values()]
    secants = [Secants(start.twin, window) for window in study.windows]
    lawful = Found(named.state)
    while True:
        study.report("searching the residual for laws")
        # A law with the same formula as a cause in the model is not tried, because it would only rename this
        # cause.
        formulas = {get_effect(name).apply for name in named.state.twin.names}
        laws = [law for law in all_laws if law.apply not in formulas]
        lawful = search(lawful, laws, 4, secants)
        if not lawful.causes:
            lawful.state = named.state
        study.report("searching for tables that describe the residual")
        described = describe(lawful.state, tables, 2, secants)
        if named.causes:
            in_place = lawful.state
            # A table can fit almost anything, so it must gain more than all causes together.
            if described and described[0].gain_nm2 > start.mse_nm2 - named.state.mse_nm2:
                in_place = with_effect(in_place, described[0], from_here=True)
            left_nm2 = rest(in_place).mean_nm2
            check = Check(in_place, [*named.causes, *lawful.causes], laws, tables, left_nm2, secants)
            named.causes = [check.of(cause) for cause in named.causes]
            if not any(one.reason for one in named.causes):
                named.causes = [check.beside_table(check.beside_laws(one)) for one in named.causes]
        wrong = sorted((one for one in named.causes if one.reason), key=lambda one: one.judgement.gain_nm2)
        if not wrong:
            return lawful, _in_model(lawful.state, described)
        # Causes that may merely correct the formula of another effect are removed first, so that the other
        # effect is judged without them.
        for one in [one for one in wrong if one.corrects] or wrong[:1]:
            study.report(f"{one.name}: {one.reason}")
            named.refused[one.name] = one.reason
            named.failed.append(one)
            named.causes.remove(one)
            named.state = named.state.without(one.name) if named.causes else start
            lawful.state = lawful.state.without(one.name)


def _in_model(state: State, described: Sequence[Screened]) -> Found:
    """Add tables to the model, one after the other. A table is kept only if held-out scans still confirm it
    after it has been fitted together with all other parameters of the model.
    """
    found = Found(state)
    for table in described:
        fitted = with_effect(found.state, table, from_here=True)
        judgement = judge_states(found.state, fitted)
        if not judgement.reason(table.by):
            found.state = fitted
            found.causes.append(Cause(table.name, table.by, (), judgement, table.family_p, table.group_p))
    return found
