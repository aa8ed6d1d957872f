"""From what the loop found to ``close_loop.json``: errors, verdict, shares, and what is left."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from litho_data.foundation.run_facts import run_info
from litho_data.foundation.units import NM_PER_UM
from litho_data.store.schema import DatasetId
from litho_models.effects import CATALOGUE
from litho_models.loop import equal_terms
from litho_models.loop.equal_terms import BeforeAfter, TermSet
from litho_models.loop.findings import LoopFindings
from litho_models.loop.nested import Nested
from litho_models.loop.parameters import at_bounds
from litho_models.loop.probes.layout import LAYOUT_FEATURES
from litho_models.loop.result.added_effects import added_effects
from litho_models.loop.result.candidates import all_candidates
from litho_models.loop.result.exporting import part_of
from litho_models.loop.result.record import (
    AddedEffect,
    Chosen,
    ChosenKind,
    CloseLoop,
    EqualTerms,
    Errors,
    Explainable,
    GainPart,
    NestedResult,
    Residual,
    Shares,
    TermsError,
    Verdict,
)
from litho_models.loop.selection.confirming import FEWEST_SCANS, SMALLEST_SHARE
from litho_models.loop.structure import fewest_scans_for_structure
from litho_models.loop.study import Score
from litho_models.scan_terms import NuisanceProtocol, Policy, Terms
from litho_models.scoring.noise_floor import NoiseFloor, floor_of_residuals
from litho_models.scoring.pairs import over_prints, over_scans
from litho_models.scoring.statistics import interval
from litho_models.splits.folds import Split

_NO_TERMS: Terms = frozenset()


def summarise(findings: LoopFindings, *, dataset: DatasetId, base_name: str, dropped: list[str]) -> CloseLoop:
    """The result record of one run.

    Args:
        findings: what the loop found.
        dropped: scans left out, with reason.
    """
    found, locked = equal_terms.scores(findings), findings.locked_scores
    elsewhere = [scan.stored.print_id for scan in findings.locked]
    effects = added_effects(findings)
    tested = [e for e in effects if e.name not in CATALOGUE or not CATALOGUE[e.name].per_scan]
    unexplained = _signature(findings)
    fewest = max(FEWEST_SCANS, fewest_scans_for_structure(len(findings.structure)))
    verdict: Verdict = "nothing-missing"
    if any(e.verdict != "partial" and e.name != LAYOUT_FEATURES for e in tested):
        verdict = "traced"
    elif tested or unexplained:
        verdict = "unexplained"
    elif len(findings.development) < fewest:
        verdict = "too-few-scans"
    return CloseLoop(
        run=run_info([findings.config.seed], len(findings.development) + len(findings.locked), dropped),
        dataset=dataset,
        base_model=base_name,
        at_bounds=at_bounds(findings.final.fits.chain),
        split=Split(kind="grouped", folds=findings.study.folds, lock_box=findings.lock_box),
        nuisance=NuisanceProtocol.of_policy("offset", findings.config.seed, findings.config.background),
        prior_hypotheses=list(findings.config.prior_hypotheses),
        noise_floor=_noise_floor(findings, found),
        before=_errors(found, 0, findings.config.seed),
        after=_errors(found, 1, findings.config.seed),
        locked_before=_errors(locked, 0, findings.config.seed) if locked else None,
        locked_after=_errors(locked, 1, findings.config.seed) if locked else None,
        equal_terms=_equal_terms(found, findings.prints, findings.config.seed),
        locked_equal_terms=_equal_terms(locked, elsewhere, findings.config.seed) if locked else None,
        gain_split=_gain_split(findings, effects),
        nested=_nested(findings.nested, findings.config.seed) if findings.nested else None,
        effects=effects,
        candidates=all_candidates(findings, {e.name for e in effects}),
        shares=_shares(findings),
        explainable=[
            Explainable(
                stage=stage,
                squared_error_nm2=float(rest.squares_nm2.mean()),
                k=rest.k,
                explained_nm2=rest.mean_nm2,
                explained_ci95_nm2=rest.ci95_nm2,
            )
            for stage, rest in findings.explainable.items()
        ],
        # Only a measured floor can show that it is reached; the loop estimates its own: never at-floor.
        residual=Residual(state="unexplained" if unexplained else "undecided", signature=unexplained),
        verdict=verdict,
        fewest_scans=fewest,
    )


def _signature(findings: LoopFindings) -> str:
    """What is left to be explained, in words; empty where nothing shows."""
    parts = [
        f"follows {t.name} (p = {t.p:.4f}, {100 * t.share:.1f} % of the squared error)"
        for t in sorted(findings.structured, key=lambda t: -t.share)
    ]
    if findings.rest.matters or findings.probed.state is not findings.probed.traced:
        parts.append(f"layout and place explain {100 * findings.rest.share:.1f} % of the squared error")
    if (blobs := findings.probed.defects.share_of_squares) > SMALLEST_SHARE:
        parts.append(f"localised defects hold {100 * blobs:.1f} % of the squared error")
    return "; ".join(parts)


def _noise_floor(findings: LoopFindings, found: Mapping[TermSet, BeforeAfter]) -> NoiseFloor:
    """What the residuals after correction have in common with none of their like; else a lower bound."""
    after: dict[Policy, tuple[float, list[np.ndarray]]] = {
        name: (score.degrees_of_freedom, score.residual_um)
        for name, (_, score) in found.items()
        if name != "accepted"
    }
    scans = [scan.stored for scan in findings.development]
    estimate = floor_of_residuals("the corrected model", scans, after, findings.config.seed)
    if estimate.mae_nm is not None:
        return estimate
    rms_nm, mae_nm = findings.floor_nm
    return NoiseFloor(
        mae_nm=mae_nm,
        rmse_nm=rms_nm,
        kind="lower-bound",
        source="second differences along x of the held-out residual: blind to correlated roughness",
    )


def _errors(found: Mapping[TermSet, BeforeAfter], which: int, seed: int) -> Errors:
    without_fit, datum_free = found["none"][which], found["offset"][which]
    return Errors(
        mae_abs_nm=without_fit.mean_mae_nm,
        mae_datum_free_nm=datum_free.mean_mae_nm,
        mae_datum_free_ci95_nm=datum_free.interval_nm(seed),
        rmse_datum_free_nm=datum_free.rmse_nm,
    )


def _equal_terms(found: Mapping[TermSet, BeforeAfter], prints: Sequence[str], seed: int) -> list[EqualTerms]:
    rows = []
    for name, (before, after) in found.items():
        if name == "none":
            continue
        gains = (before.mae_nm - after.mae_nm).tolist()
        rows.append(
            EqualTerms(
                terms=name,
                before=_terms_error(before),
                after=_terms_error(after),
                gain_nm=before.mean_mae_nm - after.mean_mae_nm,
                over_scans=over_scans(gains, seed),
                over_prints=over_prints(gains, prints, seed),
            )
        )
    return rows


def _gain_split(findings: LoopFindings, effects: Sequence[AddedEffect]) -> list[GainPart]:
    by_name = {effect.name: effect for effect in effects}
    return [GainPart(part=part_of(by_name[step.name]), **vars(step)) for step in findings.gain_steps]


def _nested(found: Nested, seed: int) -> NestedResult:
    kinds: dict[ChosenKind, list[str]] = {
        "named": [name for part in found.parts for name in part.named],
        "generic": [name for part in found.parts for name in part.generic],
        "per-scan": [name for part in found.parts for name in part.accepted],
    }
    return NestedResult(
        held_out=found.held_out,
        selections=len(found.parts),
        equal_terms=_equal_terms(found.scores, found.prints, seed),
        chosen=[
            Chosen(name=name, kind=kind, times=times)
            for kind, names in kinds.items()
            for name, times in Counter(names).most_common()
        ],
    )


def _terms_error(score: Score) -> TermsError:
    return TermsError(
        k=score.degrees_of_freedom,
        mae_nm=score.mean_mae_nm,
        mae_ci95_nm=interval(score.mae_nm.tolist()),
        rmse_nm=score.rmse_nm,
    )


def _shares(findings: LoopFindings) -> Shares:
    """Parts of the base model's squared error without any fit; they sum to 1."""
    total = float(findings.errors(findings.base, _NO_TERMS).mse_nm2.mean())
    freed = min(total, float(findings.errors(findings.base, findings.terms).mse_nm2.mean()))
    named = min(freed, float(findings.errors(findings.search.state, findings.terms).mse_nm2.mean()))
    final = findings.errors(findings.final, findings.terms)
    left = min(named, float(final.mse_nm2.mean()))
    floor = min(left, findings.floor_nm[0] ** 2)
    defects = min(left - floor, _squares_in_defects_nm2(findings, final))
    parts = [total - freed, freed - named, named - left, defects, left - floor - defects, floor]
    return Shares.model_validate(
        dict(
            zip(
                ("nuisance", "effects", "traced", "masked_defects", "unexplained_structured", "noise_floor"),
                np.array(parts) / max(total, np.finfo(float).tiny),
                strict=True,
            )
        )
    )


def _squares_in_defects_nm2(findings: LoopFindings, final: Score) -> float:
    """What the pixels of localised defects add to the mean squared error, nm²."""
    parts = []
    for residual, mask in zip(final.residual_um, findings.probed.defects.masks, strict=True):
        scored = np.isfinite(residual)
        parts.append((residual[scored & mask] ** 2).sum() / max(scored.sum(), 1) * NM_PER_UM**2)
    return float(np.mean(parts))
