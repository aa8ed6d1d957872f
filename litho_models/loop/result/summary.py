"""From what the loop found to ``close_loop.json``: errors, verdict, shares, and what is left."""

from __future__ import annotations

import numpy as np

from litho_data.foundation.run_facts import run_info
from litho_data.foundation.units import NM_PER_UM
from litho_data.store.schema import DatasetId
from litho_models.effects import CATALOGUE
from litho_models.loop.findings import LoopFindings
from litho_models.loop.result.added_effects import added_effects
from litho_models.loop.result.candidates import all_candidates
from litho_models.loop.result.record import (
    CloseLoop,
    Errors,
    Residual,
    Shares,
    Verdict,
)
from litho_models.loop.study import DATUM_FREE, Score
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.noise_floor import NoiseFloor
from litho_models.splits.folds import Split

_NO_TERMS: frozenset[str] = frozenset()


def summarise(findings: LoopFindings, *, dataset: DatasetId, base_name: str, dropped: list[str]) -> CloseLoop:
    """The result record of one run.

    Args:
        findings: what the loop found.
        dropped: scans left out, with reason.
    """
    locked = findings.locked_scores
    effects = added_effects(findings)
    tested = [e for e in effects if e.name not in _span_names()]
    structured = findings.structured
    verdict: Verdict = "traced" if tested else "unexplained" if structured else "nothing-missing"
    floor_rms, floor_mae = findings.floor_nm
    return CloseLoop(
        schema=CloseLoop.SCHEMA,
        run=run_info([findings.config.seed], len(findings.development) + len(findings.locked), dropped),
        dataset=dataset,
        base_model=base_name,
        split=Split(kind="grouped", folds=findings.study.folds, lock_box=findings.lock_box),
        nuisance=NuisanceProtocol.of_policy("offset", findings.config.seed, findings.config.background),
        prior_hypotheses=list(findings.config.prior_hypotheses),
        noise_floor=NoiseFloor(
            mae_nm=floor_mae,
            rmse_nm=floor_rms,
            kind="lower-bound",
            source="second differences along x of the held-out residual: blind to correlated roughness",
        ),
        before=_errors(
            findings.errors(findings.base, _NO_TERMS),
            findings.errors(findings.base, DATUM_FREE),
            findings.config.seed,
        ),
        after=_errors(
            findings.errors(findings.final, _NO_TERMS),
            findings.errors(findings.final, findings.terms),
            findings.config.seed,
        ),
        locked_before=_errors(*locked[0], findings.config.seed) if locked else None,
        locked_after=_errors(*locked[1], findings.config.seed) if locked else None,
        effects=effects,
        candidates=all_candidates(findings, {e.name for e in effects}),
        shares=_shares(findings),
        residual=Residual(
            # Only a measured floor can show that it is reached; the loop has a lower bound: never at-floor.
            state="unexplained" if structured else "undecided",
            signature="; ".join(
                f"follows {t.name} (p = {t.p:.4f}, {100 * t.share:.1f} % of the squared error)"
                for t in sorted(structured, key=lambda t: -t.share)
            ),
        ),
        verdict=verdict,
    )


def _span_names() -> set[str]:
    return {name for name, effect in CATALOGUE.items() if effect.per_scan}


def _errors(without_fit: Score, datum_free: Score, seed: int) -> Errors:
    return Errors(
        mae_abs_nm=without_fit.mean_mae_nm,
        mae_datum_free_nm=datum_free.mean_mae_nm,
        mae_datum_free_ci95_nm=datum_free.interval_nm(seed),
        rmse_datum_free_nm=datum_free.rmse_nm,
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
