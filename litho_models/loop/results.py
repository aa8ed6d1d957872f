"""From what was found to its record: errors side by side, strengths with intervals, reasons for the rest."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from litho_models.effects import CATALOGUE, UNTESTABLE, get_effect
from litho_models.fitting.least_squares import Linearised, eliminated, eliminated_sum
from litho_models.loop.closing import Closed
from litho_models.loop.fits import RULES, State
from litho_models.loop.judging import FAMILY_P, FEWEST_SCANS
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.record import (
    Candidate,
    CandidateVerdict,
    CloseLoop,
    EffectVerdict,
    ErrorRow,
    Explained,
    FoundEffect,
    ScanFinding,
    Strength,
    Verdict,
    error_of,
)
from litho_models.loop.screening import SMALLEST_RETAINED
from litho_models.loop.search import Cause, separating
from litho_models.scan_terms.grouped import ALL
from litho_models.scoring.statistics import over_prints, over_units
from litho_models.simulator import Simulator

_BASE_ABSORBS = 1e-2
# Numbers whose estimates move together this much are known together only.
_CONFOUNDED = 0.95


def record(
    closed: Closed,
    errors: list[ErrorRow],
    *,
    single_scans: list[ScanFinding],
    left_out_nm: Mapping[str, float],
    survives_on: Mapping[str, list[str]],
    **given: Any,
) -> CloseLoop:
    """The record of one run.

    Args:
        closed: what was found; ``errors``: of ``error_rows``; ``single_scans``: what those add.
        left_out_nm, survives_on: of each effect, see ``FoundEffect``; ``given``: other fields as they are.
    """
    study, scans = closed.study, closed.study.scans
    effects = [_found(closed, one, left_out_nm, survives_on) for one in closed.found]
    before, after = error_of(errors, "base"), error_of(errors, "all")
    assert before is not None
    assert after is not None
    was_nm, is_nm = before.leading_by_scan_nm, after.leading_by_scan_nm
    gains = [was_nm[scan.id] - is_nm[scan.id] for scan in scans]
    prints = [scan.stored.print_id for scan in scans]
    return CloseLoop(
        **given,
        base_values=_values(closed.base.twin),
        corrected_values=_values(closed.final.twin),
        at_bounds=closed.final.twin.at_bounds(),
        groups={name: list(labels) for name, labels in study.groups.items() if name != ALL},
        errors=errors,
        gain_nm=float(np.mean(gains)),
        over_scans=over_units(gains, seed=study.seed),
        over_prints=over_prints(gains, prints, study.seed),
        effects=effects,
        candidates=_candidates(closed, effects, {one.name for one in single_scans}),
        single_scans=single_scans,
        confounded=confounded(closed.final),
        explained=[
            Explained(
                stage=stage,
                squared_error_nm2=float(rest.squares_nm2.mean()),
                explained_nm2=rest.mean_nm2,
                matters=rest.matters,
            )
            for stage, rest in closed.rests.items()
        ],
        verdict=_verdict(closed, effects),
        fewest_scans=FEWEST_SCANS,
    )


def _verdict(closed: Closed, effects: Sequence[FoundEffect]) -> Verdict:
    if any(one.knowledge != "description" for one in effects):
        return "traced"
    if effects:
        return "described"
    if len(closed.study.scans) < FEWEST_SCANS:
        return "too-few-scans"
    left = [*closed.rests.values()][-1].matters or closed.chosen.named.refused
    return "unexplained" if left else "nothing-missing"


def _values(twin: Twin) -> dict[str, float]:
    """The base's numbers by their physical names; empty for a base that is not fitted."""
    base = twin.placed().base
    if not twin.own or not isinstance(base, Simulator):
        return {}
    known = getattr(base, "values", None)
    if known is not None:
        return {name: float(value.detach()) for name, value in known.items()}
    return {
        f"{name}{f' {i}' if p.numel() > 1 else ''}": float(value)
        for name, p in base.named_parameters()
        for i, value in enumerate(p.detach().reshape(-1))
    }


def _found(
    closed: Closed,
    cause: Cause,
    left_out_nm: Mapping[str, float],
    survives_on: Mapping[str, list[str]],
) -> FoundEffect:
    effect = get_effect(cause.name)
    verdicts: dict[str, EffectVerdict] = {"law": "lawful", "description": "described"}
    verdict = verdicts.get(effect.knowledge, "confusable" if cause.alike else "explained")
    reshaped = next((c.reshaped_share for c in closed.chosen.checked if c.cause.name == cause.name), None)
    roles = {effect.role, *(get_effect(name).role for name in cause.alike)}
    return FoundEffect(
        name=cause.name,
        title=effect.title,
        knowledge=effect.knowledge,
        role=effect.role if len(roles) == 1 else "undetermined",
        stage=effect.stage,
        verdict=verdict,
        by=cause.by,
        strengths=_strengths(closed, cause),
        confusable_with=list(cause.alike),
        separating_experiment=separating([cause.name, *cause.alike]),
        gain_nm2=cause.judgement.gain_nm2,
        before_nm2=cause.judgement.before_nm2,
        scans_improved=cause.judgement.improved,
        p_confirm=cause.judgement.p,
        family_p=cause.family_p,
        group_p=cause.group_p,
        reshaped_share=reshaped,
        left_out_nm=left_out_nm.get(cause.name),
        survives_on=survives_on.get(cause.name, []),
    )


def _strengths(closed: Closed, cause: Cause) -> dict[str, list[Strength]]:
    """Numbers of an effect with intervals from what each print (or scan) asks for; of a table alone."""
    from scipy.stats import t

    state, effect, name = closed.final, get_effect(cause.name), cause.name
    if cause.values:
        return {
            parameter: [
                Strength(label=label, value=values[parameter], unit=facts.unit, ci95=None)
                for label, values in cause.values.items()
            ]
            for parameter, facts in effect.parameters.items()
        }
    twin = state.twin
    units = independent(closed.study.scans)
    sd = np.sqrt(np.maximum(np.diag(clustered_covariance(state.linear, units)), 0.0))
    reach = float(t.ppf(0.975, max(len(set(units)) - 1, 1)))
    found: dict[str, list[Strength]] = {}
    for at, slot in enumerate(twin.slots, twin.own):
        if slot.effect == name:
            value, half = float(twin.vector[at]), reach * float(sd[at])
            found.setdefault(slot.parameter, []).append(
                Strength(
                    label=slot.label or "",
                    value=value,
                    unit=slot.facts.unit,
                    ci95=(value - half, value + half) if sd[at] else None,
                )
            )
    for parameter, value in twin.choices[name].items():
        found[parameter] = [
            Strength(label="", value=value, unit=effect.parameters[parameter].unit, ci95=None)
        ]
    return found


def independent(scans: Sequence[PreparedScan]) -> list[str]:
    """The unit that each scan belongs to in an interval: its print, or itself where prints are too few."""
    prints = [scan.stored.print_id for scan in scans]
    return prints if 2 < len(set(prints)) < len(prints) else [scan.id for scan in scans]


def clustered_covariance(linear: Sequence[Linearised], units: Sequence[str]) -> np.ndarray:
    """Covariance (p, p) of fitted numbers, by what each unit asks for at the optimum.

    Args:
        linear: each window there; ``units``: the print, or the scan, that each belongs to.
    """
    parts = [eliminated(part, RULES.term_weight) for part in linear]
    normal = np.sum([part[0] for part in parts], axis=0)
    inverse = np.linalg.pinv(normal, rcond=1e-10, hermitian=True)
    names = sorted(set(units))
    scores = np.stack(
        [np.sum([p[1] for p, own in zip(parts, units, strict=True) if own == name], axis=0) for name in names]
    )
    return inverse @ (scores.T @ scores) @ inverse * len(names) / max(len(names) - 1, 1)


def confounded(state: State) -> list[tuple[str, str, float]]:
    """Pairs of fitted numbers that these scans determine together only, with their correlation."""
    twin = state.twin
    normal = eliminated_sum(state.linear, RULES.term_weight)[0]
    free = np.flatnonzero(np.diag(normal) > 0)
    covariance = np.linalg.pinv(normal[np.ix_(free, free)], rcond=1e-10, hermitian=True)
    sd = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = covariance / np.outer(sd, sd)
    own = [*_values(twin)]
    if len(own) != twin.own:
        own = [f"base {i}" for i in range(twin.own)]
    names = [*own, *(" ".join(filter(None, (s.effect, s.parameter, s.label))) for s in twin.slots)]
    pairs = zip(*np.nonzero(np.triu(np.abs(correlation), 1) >= _CONFOUNDED), strict=True)
    return [(names[free[i]], names[free[j]], float(correlation[i, j])) for i, j in pairs]


def _candidates(closed: Closed, added: Sequence[FoundEffect], seen: Collection[str]) -> list[Candidate]:
    """Why each other effect was not added; ``seen``: those of single scans, which are told apart."""
    sets = {other: one.name for one in added for other in one.confusable_with}
    done = {*seen, *(one.name for one in added)}
    films = closed.study.of_films
    untestable = {} if films else {**UNTESTABLE, **closed.untestable}
    found = [
        Candidate(name=name, verdict="not-testable", reason=reason)
        for name, reason in untestable.items()
        if name not in done
    ]
    found += [
        _candidate(closed, name, sets)
        for name, effect in CATALOGUE.items()
        if name not in {*done, *untestable} and not effect.per_scan and effect.of_films == films
    ]
    return found


def _candidate(closed: Closed, name: str, sets: Mapping[str, str]) -> Candidate:
    named = closed.chosen.named
    last = named.last.get(name) or named.first.get(name)
    p = named.family_p.get(name)
    verdict: CandidateVerdict
    if name in sets:
        verdict, reason = "confusable", f"cannot be told from {sets[name]}, which was added"
    elif any(one.cause.name == name and one.reason for one in closed.chosen.checked):
        verdict, reason = "resembles", named.refused.get(name, "")
    elif last is None:
        verdict, reason = "not-testable", "not screened"
    elif len(closed.study.scans) < FEWEST_SCANS:
        verdict, reason = (
            "too-few-scans",
            f"{len(closed.study.scans)} scans to choose and confirm on, at least {FEWEST_SCANS} needed",
        )
    elif last.beside_base < SMALLEST_RETAINED:
        verdict, reason = "not-testable", "on these layouts it changes nothing that single scans do not"
    elif last.retained < max(_BASE_ABSORBS * last.beside_base, SMALLEST_RETAINED):
        verdict, reason = "absorbed", "numbers of the base do the same: its fit has taken it up"
    elif not last.allowed and p is not None and p <= FAMILY_P:
        verdict, reason = "contradicted", "its best strength has the wrong sign"
    else:
        verdict = "below-noise"
        reason = named.refused.get(name, f"gains {last.gain_nm2:.1f} nm² of {named.state.mse_nm2:.0f} nm²")
    return Candidate(
        name=name, verdict=verdict, reason=reason, p_screen=p, gain_nm2=last.gain_nm2 if last else None
    )
