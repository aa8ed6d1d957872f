"""Make the record of a loop. It contains the errors of the models, the effects that were found, and the
rejected effects. The strengths of the effects have confidence intervals, and each rejection has a reason.
"""

from collections.abc import Mapping, Sequence
from itertools import compress
from typing import Any

import numpy as np
from scipy.stats import t

from litho_models.effects import UNTESTABLE, get_effect, screened_effects
from litho_models.effects.effect import Knowledge
from litho_models.fitting.least_squares import Linearised, eliminated
from litho_models.loop.closing import Closed
from litho_models.loop.fits import RULES
from litho_models.loop.joint_fit import SMALLEST_RETAINED
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
from litho_models.loop.search import Cause, separating
from litho_models.scoring.statistics import over_prints, over_units
from litho_models.simulator import Simulator

# The values of the parameters of one effect, keyed by the name of the parameter.
Strengths = dict[str, list[Strength]]


def record(
    closed: Closed,
    errors: list[ErrorRow],
    *,
    single_scans: list[ScanFinding],
    left_out_nm: Mapping[str, float],
    **given: Any,
) -> CloseLoop:
    """Make the record of one run of the loop.

    Args:
        closed: the loop, as returned by ``close``.
        errors: the errors of all models, as returned by ``HeldOut.errors``.
        single_scans: findings about per-scan terms and marks.
        left_out_nm: values of ``FoundEffect.left_out_nm``, keyed by the name of the effect.
        given: the remaining fields of the record.
    """
    study = closed.study
    strengths = _strengths(closed)
    effects = [
        _found(closed, one, strengths[one.name], left_out_nm[one.name])
        for one in (*closed.traced, *closed.described.causes)
    ]
    headline = {row.model: row.leading_by_scan_nm for row in errors if row.is_headline}
    gains = [headline["base"][scan.id] - headline["all"][scan.id] for scan in study.scans]
    return CloseLoop(
        **given,
        base_model=closed.base_name,
        base_values=_values(closed.base.twin),
        corrected_values=_values(closed.final.twin),
        errors=errors,
        effects=effects,
        candidates=_candidates(closed, effects, single_scans),
        single_scans=single_scans,
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
        gain_nm=float(np.mean(gains)),
        over_scans=over_units(gains, seed=study.seed),
        over_prints=over_prints(gains, [scan.print_id for scan in study.scans], study.seed),
    )


def _verdict(closed: Closed, effects: Sequence[FoundEffect]) -> Verdict:
    if any(one.knowledge != "description" for one in effects):
        return "traced"
    if effects:
        return "described"
    if len(closed.study.scans) < FEWEST_SCANS:
        return "too-few-scans"
    left = [*closed.rests.values()][-1].matters or closed.named.refused
    return "unexplained" if left else "nothing-missing"


def _values(twin: Twin) -> dict[str, float]:
    """Return the fitted values of the scalar parameters of the base model, keyed by name. The result is empty
    if the base model was not fitted.
    """
    base = twin.fitted_base
    known = base.values if twin.own and isinstance(base, Simulator) else {}
    return {name: value.item() for name, value in known.items()}


def _found(closed: Closed, cause: Cause, strengths: Strengths, left_out_nm: float) -> FoundEffect:
    effect, judgement, names = get_effect(cause.name), cause.judgement, [cause.name, *cause.alike]
    role, *others = {get_effect(name).role for name in names}
    knowledge = effect.knowledge
    # If another base does not need a cause, the cause may only correct an error of the chosen base.
    if knowledge == "cause" and cause.role is None and not closed.needed_by_all(cause):
        knowledge = "description"
    verdicts: dict[Knowledge, EffectVerdict] = {
        "cause": "confusable" if cause.alike else "explained",
        "law": "lawful",
        "description": "described",
    }
    return FoundEffect(
        name=cause.name,
        title=effect.title,
        knowledge=knowledge,
        role=cause.role or ("undetermined" if others else role),
        verdict="explained" if cause.role else verdicts[knowledge],
        by=cause.by,
        strengths=strengths,
        confusable_with=list(cause.alike),
        separating_experiment=separating(names),
        gain_nm2=judgement.gain_nm2,
        before_nm2=judgement.before_nm2,
        scans_improved=judgement.improved,
        p_confirm=judgement.p,
        family_p=cause.family_p,
        group_p=cause.group_p,
        left_out_nm=left_out_nm,
        survives_on=[*cause.survives_on],
    )


def _strengths(closed: Closed) -> dict[str, Strengths]:
    """Return the values of the parameters of all effects, keyed by the name of the effect and by the name of
    the parameter. The confidence intervals of fitted values are computed from the scatter over prints. If
    there are too few prints, or if a strength applies to only one print, the scatter over scans is used
    instead. A strength that applies to only one scan has no interval.
    """
    twin, scans = closed.final.twin, closed.study.scans
    kinds = []
    for units in (independent(scans), [scan.id for scan in scans]):
        variances = np.diag(clustered_covariance(closed.final.linear, units))[twin.own :].tolist()
        kinds.append((units, dict(zip(twin.slots, variances, strict=True))))
    found: dict[str, Strengths] = {name: {} for name in twin.names}
    for slot, value in twin.effects.items():
        own, ci95 = [*map(slot.is_of, scans)], None
        # At the optimum, the scores (gradients) of the units add up to zero, so the score of a single unit
        # would be zero and would show no scatter.
        units, known = next((kind for kind in kinds if len({*compress(kind[0], own)}) > 1), ([], {}))
        # Choices are not fitted, so they have no variance.
        if known.get(slot, 0) > 0:
            ci95 = t.interval(0.95, len({*units}) - 1, value, np.sqrt(known[slot]))
        strength = Strength(label=slot.label, value=value, unit=slot.facts.unit, ci95=ci95)
        found[slot.effect].setdefault(slot.parameter, []).append(strength)
    return found


def independent(scans: Sequence[PreparedScan]) -> list[str]:
    """Return, for each scan, the print to which it belongs, or the scan itself if there are too few prints.
    Confidence intervals treat the returned units as independent.
    """
    prints = [scan.print_id for scan in scans]
    return prints if 2 < len(set(prints)) < len(prints) else [scan.id for scan in scans]


def clustered_covariance(linear: Sequence[Linearised], units: Sequence[str]) -> np.ndarray:
    """Return the cluster-robust covariance of the p fitted parameters, of shape (p, p).

    Args:
        linear: the linearised least-squares problem of each scan at the optimum.
        units: the cluster (print or scan) to which each scan belongs.
    """
    normals, gradients, _ = zip(*(eliminated(part, RULES.term_weight) for part in linear), strict=True)
    inverse = np.linalg.pinv(np.sum(normals, axis=0), rcond=1e-10, hermitian=True)
    names, cluster = np.unique(units, return_inverse=True)
    scores = np.zeros((len(names), len(inverse)))
    np.add.at(scores, cluster, gradients)
    return inverse @ (scores.T @ scores) @ inverse * len(names) / max(len(names) - 1, 1)


def _candidates(
    closed: Closed, added: Sequence[FoundEffect], single_scans: Sequence[ScanFinding]
) -> list[Candidate]:
    """List the effects that were not added to the model, each with the reason.

    Args:
        closed: the loop.
        added: the effects that were added.
        single_scans: findings about per-scan terms and marks, which the record lists elsewhere.
    """
    named, films, count = closed.named, closed.study.of_films, len(closed.study.scans)
    sets = {other: one.name for one in added for other in one.confusable_with}
    excluded = {other: one.name for one in closed.traced for other in one.excluded}
    untestable = {} if films else {**UNTESTABLE, **closed.untestable}
    tried = [one.name for one in screened_effects() if one.of_films == films]
    told = {*(one.name for one in added), *(one.name for one in single_scans)}

    def refused(name: str) -> tuple[CandidateVerdict, str]:
        last, reason = named.last.get(name), named.refused.get(name, "")
        if name in untestable:
            return "not-testable", untestable[name]
        if name in excluded:
            return "contradicted", f"later prints exclude it: {excluded[name]} fits them better"
        if name in sets:
            return "confusable", f"cannot be distinguished from {sets[name]}, which was added"
        if any(one.name == name for one in named.failed):
            return "resembles", reason
        if last is None:
            return "not-testable", "it was not screened"
        if count < FEWEST_SCANS:
            few = f"{count} scans are too few: at least {FEWEST_SCANS} are needed to confirm it"
            return "too-few-scans", few
        if last.beside_base < SMALLEST_RETAINED:
            return "not-testable", "its change on these layouts cannot be distinguished from per-scan terms"
        if last.retained < max(0.01 * last.beside_base, SMALLEST_RETAINED):
            return "absorbed", "a change of the parameters of the base model has the same effect"
        if not last.allowed and named.first[name].family_p <= FAMILY_P:
            return "contradicted", "its best-fitting strength has the wrong sign"
        gained = f"it removes only {last.gain_nm2:.1f} of {named.state.mse_nm2:.0f} nm² of the squared error"
        return "below-noise", reason or gained

    return [
        Candidate(
            name=name,
            verdict=verdict,
            reason=reason,
            p_screen=named.first[name].family_p if name in named.first else None,
            gain_nm2=named.last[name].gain_nm2 if name in named.last else None,
        )
        for name in dict.fromkeys([*untestable, *tried])
        if name not in told
        for verdict, reason in [refused(name)]
    ]
