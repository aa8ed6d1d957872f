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
)
from litho_models.loop.screening import SMALLEST_RETAINED
from litho_models.loop.search import Cause, separating
from litho_models.scan_terms.grouped import ALL
from litho_models.scoring.statistics import over_prints, over_units
from litho_models.simulator import Simulator


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
    by_stage = {row.model: row for row in errors if row.is_headline}
    before, after = by_stage["base"], by_stage["all"]
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
    """Numbers of an effect with intervals from what each print (or scan) asks for."""
    from scipy.stats import t

    facts, found = get_effect(cause.name).parameters, dict[str, list[Strength]]()

    def add(parameter: str, label: str, value: float, half: float = 0.0) -> None:
        ci95 = (value - half, value + half) if half else None
        own = Strength(label=label, value=value, unit=facts[parameter].unit, ci95=ci95)
        found.setdefault(parameter, []).append(own)

    twin, units = closed.final.twin, independent(closed.study.scans)
    sd = np.sqrt(np.maximum(np.diag(clustered_covariance(closed.final.linear, units)), 0.0))
    reach = t.ppf(0.975, max(len(set(units)) - 1, 1)) * sd
    for slot, own, half in zip(twin.slots, twin.vector[twin.own :], reach[twin.own :], strict=True):
        if slot.effect == cause.name:
            add(slot.parameter, slot.label or "", float(own), float(half))
    for parameter, value in twin.choices.get(cause.name, {}).items():
        add(parameter, "", value)
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
    correlation = np.triu(covariance / np.outer(sd, sd), 1)
    own = [*_values(twin)]
    if len(own) != twin.own:
        own = [f"base {i}" for i in range(twin.own)]
    names = [*own, *(" ".join(filter(None, (s.effect, s.parameter, s.label))) for s in twin.slots)]
    pairs = np.argwhere(np.abs(correlation) >= 0.95).tolist()
    return [(names[free[i]], names[free[j]], float(correlation[i, j])) for i, j in pairs]


def _candidates(closed: Closed, added: Sequence[FoundEffect], seen: Collection[str]) -> list[Candidate]:
    """Why each other effect was not added; ``seen``: those of single scans, which are told apart."""
    sets = {other: one.name for one in added for other in one.confusable_with}
    films = closed.study.of_films
    untestable = {} if films else {**UNTESTABLE, **closed.untestable}
    tried = [one.name for one in CATALOGUE.values() if not one.per_scan and one.of_films == films]
    names = dict.fromkeys([*untestable, *tried])
    found = []
    for name in names:
        if name not in seen and all(one.name != name for one in added):
            verdict, reason = _refused(closed, name, sets, untestable)
            last = closed.chosen.named.screened(name)
            found.append(
                Candidate(
                    name=name,
                    verdict=verdict,
                    reason=reason,
                    p_screen=closed.chosen.named.family_p.get(name),
                    gain_nm2=last.gain_nm2 if last else None,
                )
            )
    return found


def _refused(
    closed: Closed, name: str, sets: Mapping[str, str], untestable: Mapping[str, str]
) -> tuple[CandidateVerdict, str]:
    """Why an effect is not in the model."""
    named, count = closed.chosen.named, len(closed.study.scans)
    last, refused = named.screened(name), named.refused.get(name, "")
    if name in untestable:
        return "not-testable", untestable[name]
    if name in sets:
        return "confusable", f"cannot be told from {sets[name]}, which was added"
    if any(one.cause.name == name and one.reason for one in closed.chosen.checked):
        return "resembles", refused
    if last is None:
        return "not-testable", "not screened"
    if count < FEWEST_SCANS:
        return "too-few-scans", f"{count} scans to choose and confirm on, at least {FEWEST_SCANS} needed"
    if last.beside_base < SMALLEST_RETAINED:
        return "not-testable", "on these layouts it changes nothing that single scans do not"
    if last.retained < max(0.01 * last.beside_base, SMALLEST_RETAINED):
        return "absorbed", "numbers of the base do the same: its fit has taken it up"
    if not last.allowed and named.family_p[name] <= FAMILY_P:
        return "contradicted", "its best strength has the wrong sign"
    gained = f"gains {last.gain_nm2:.1f} nm² of {named.state.mse_nm2:.0f} nm²"
    return "below-noise", refused or gained
