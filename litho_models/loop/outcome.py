"""From what the loop found to ``close_loop.json``: verdicts, estimates with intervals, shares."""

from __future__ import annotations

import math

import numpy as np

from litho_models.effects import CATALOGUE, Effect
from litho_models.loop.closing import Closed
from litho_models.loop.confirming import FEWEST_SCANS
from litho_models.loop.contest import Added
from litho_models.loop.fitting import effect_slots
from litho_models.loop.measurement import MeasurementTest
from litho_models.loop.probes import AddedProbe, ProbeTest, figures
from litho_models.loop.result import (
    AddedEffect,
    Candidate,
    CandidateVerdict,
    CloseLoop,
    Dataset,
    EffectVerdict,
    Errors,
    NoiseFloor,
    Nuisance,
    ParameterEstimate,
    Residual,
    Shares,
    Split,
    Verdict,
)
from litho_models.loop.scoring import DATUM_FREE, Score
from litho_models.loop.screening import FAMILY_P, SMALLEST_RETAINED, Screened
from litho_models.loop.search import separating_experiment
from litho_models.loop.structure import LINEAR_RESPONSE, is_structured
from litho_models.metrics import NM_PER_UM
from litho_models.nuisance import BLOCK_PX
from litho_models.run_info import run_info

# Their parameters lie in the span of what every scan may add: nested tests, error without other fits.
_SPAN_EFFECTS = {"datum-offset", "z-gain", "tilt-bow"}
# Of what the effect gained.
_DOUBTFUL_SHARE = 0.1
_NO_TERMS: frozenset[str] = frozenset()


def summarise(closed: Closed, *, dataset: tuple[str, str], base_name: str, dropped: list[str]) -> CloseLoop:
    """The result record of one run.

    Args:
        closed: what the loop found.
        dataset: name and SHA-256 of the store; ``base_name``: the base model.
        dropped: scans left out, with reason.
    """
    locked = closed.locked_scores
    effects = _added(closed)
    tested = [e for e in effects if e.name not in _span_names()]
    structured = closed.structured
    verdict: Verdict = "traced" if tested else "unexplained" if structured else "nothing-missing"
    floor_rms, floor_mae = closed.floor_nm
    return CloseLoop(
        schema=CloseLoop.SCHEMA,
        run=run_info([closed.config.seed], len(closed.development) + len(closed.locked), dropped),
        dataset=Dataset(name=dataset[0], sha256=dataset[1]),
        base_model=base_name,
        split=Split(folds=int(closed.fold_of.max()) + 1, lock_box=closed.lock_box),
        nuisance=Nuisance(block_px=BLOCK_PX, seed=closed.config.seed),
        prior_hypotheses=list(closed.config.prior_hypotheses),
        noise_floor=NoiseFloor(
            mae_nm=floor_mae,
            rmse_nm=floor_rms,
            kind="lower-bound",
            source="second differences along x of the held-out residual: blind to correlated roughness",
        ),
        before=_errors(
            closed.errors(closed.base, _NO_TERMS), closed.errors(closed.base, DATUM_FREE), closed.config.seed
        ),
        after=_errors(
            closed.errors(closed.final, _NO_TERMS),
            closed.errors(closed.final, closed.terms),
            closed.config.seed,
        ),
        locked_before=_errors(*locked[0], closed.config.seed) if locked else None,
        locked_after=_errors(*locked[1], closed.config.seed) if locked else None,
        effects=effects,
        candidates=_candidates(closed, {e.name for e in effects}),
        shares=_shares(closed),
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


def _added(closed: Closed) -> list[AddedEffect]:
    """Measurement terms seen from the start, then the process effects, then terms seen only after them."""
    first = {t.effect.name: t for t in closed.first_tests if t.confirmation.passed}
    last = {t.effect.name: t for t in closed.last_tests if t.confirmation.passed}
    early = [_added_measurement(closed, first[name]) for name in first if name in last]
    late = [_added_measurement(closed, last[name]) for name in last if name not in first]
    process = [_added_process(closed, entry) for entry in closed.search.added]
    return early + process + [_added_probe(entry) for entry in closed.probed.added] + late


def _added_measurement(closed: Closed, test: MeasurementTest) -> AddedEffect:
    effect = test.effect
    return AddedEffect(
        name=effect.name,
        stage=effect.stage,
        role=effect.role,
        verdict="confusable" if test.confusable_with else "explained",
        prior_hypothesis=effect.name in closed.config.prior_hypotheses,
        parameters={
            name if name.startswith("sd") else f"{name}_sd_between_scans": ParameterEstimate(
                value=value, unit=unit, ci95=interval
            )
            for name, (value, interval, unit) in test.spread.items()
        },
        metric="mae_abs" if effect.name in _SPAN_EFFECTS else "mae_datum_free",
        before_nm=test.before.mean_mae_nm,
        after_nm=test.after.mean_mae_nm,
        gain_ci95_nm=test.confirmation.gain_ci95_nm,
        p_screen=test.p_screen,
        p_confirm=test.confirmation.p,
        scans_improved=test.confirmation.improved,
        confusable_with=list(test.confusable_with),
        separating_experiment=effect.separating,
    )


def doubtful_effects(closed: Closed) -> set[str]:
    """Names of added filters that leave another filter a good part of their own gain: near the cause, not it.

    What a doubtful effect took up was left by those before it.
    """
    # A kernel added as a generic term takes it away; a table added before may bring it out.
    tests = [*is_structured(closed.left_by_named), *is_structured(closed.structure)]
    left = max((t.share for t in tests if t.name == LINEAR_RESPONSE), default=0.0)
    left_nm2 = left * float(closed.errors(closed.search.state, closed.terms).mse_nm2.mean())
    doubtful: set[str] = set()
    for entry in reversed(closed.search.added):
        gain_nm2 = float(entry.before.mse_nm2.mean() - entry.after.mse_nm2.mean())
        if left_nm2 and entry.effect.linear and left_nm2 >= _DOUBTFUL_SHARE * gain_nm2:
            doubtful.add(entry.effect.name)
            left_nm2 += gain_nm2
    return doubtful


def _verdict_on(closed: Closed, entry: Added) -> EffectVerdict:
    if entry.effect.name in doubtful_effects(closed):
        return "traced-to-covariate"
    return "confusable" if entry.confusable_with else "explained"


def _added_process(closed: Closed, entry: Added) -> AddedEffect:
    effect, verdict = entry.effect, _verdict_on(closed, entry)
    return AddedEffect(
        name=effect.name,
        stage=effect.stage,
        role="undetermined" if verdict == "traced-to-covariate" else effect.role,
        verdict=verdict,
        prior_hypothesis=effect.name in closed.config.prior_hypotheses,
        parameters=parameter_estimates(closed, effect),
        metric="mae_datum_free",
        before_nm=entry.before.mean_mae_nm,
        after_nm=entry.after.mean_mae_nm,
        gain_ci95_nm=entry.confirmation.gain_ci95_nm,
        p_screen=entry.p_screen,
        p_confirm=entry.confirmation.p,
        scans_improved=entry.confirmation.improved,
        confusable_with=entry.confusable_with,
        separating_experiment=separating_experiment([effect.name, *entry.confusable_with]),
    )


def _added_probe(entry: AddedProbe) -> AddedEffect:
    """A generic term: where the residual lives, added to the height; never a cause."""
    return AddedEffect(
        name=entry.probe.name,
        stage="development",
        role="undetermined",
        verdict="traced-to-covariate",
        prior_hypothesis=False,
        parameters={
            name: ParameterEstimate(value=value, unit=unit, ci95=interval)
            for name, (value, unit, interval) in figures(entry.probe, entry.estimate).items()
        },
        metric="mae_datum_free",
        before_nm=entry.before.mean_mae_nm,
        after_nm=entry.after.mean_mae_nm,
        gain_ci95_nm=entry.confirmation.gain_ci95_nm,
        p_screen=entry.p_control,
        p_confirm=entry.confirmation.p,
        scans_improved=entry.confirmation.improved,
        confusable_with=[],
        separating_experiment="print and scan the same layouts turned by 90 degrees",
    )


def parameter_estimates(closed: Closed, effect: Effect) -> dict[str, ParameterEstimate]:
    """Final values on all development scans, intervals from the spread over scans; choices have none."""
    from scipy.stats import t

    fits = closed.final.fits
    slots = effect_slots(fits.chain)
    reach = float(t.ppf(0.975, max(len(closed.development) - 1, 1)))
    choices = fits.chain.values()[effect.name]
    estimates = {}
    for name, parameter in effect.parameters.items():
        if (effect.name, name) not in slots:
            estimates[name] = ParameterEstimate(value=choices[name], unit=parameter.unit, ci95=None)
            continue
        slot = slots[effect.name, name]
        value, half = float(fits.common[slot]), reach * math.sqrt(max(fits.covariance[slot, slot], 0.0))
        estimates[name] = ParameterEstimate(
            value=value, unit=parameter.unit, ci95=(value - half, value + half)
        )
    return estimates


def _candidates(closed: Closed, added: set[str]) -> list[Candidate]:
    rows = []
    tests = {t.effect.name: t for t in closed.first_tests} | {t.effect.name: t for t in closed.last_tests}
    sets = {name: entry for entry in closed.search.added for name in entry.confusable_with}
    for name in [*CATALOGUE, *(n for n in closed.untestable if n not in CATALOGUE)]:
        seen = closed.observed.get(name)
        # A term of single scans is one form of an effect; what is shorter, or already mended, is seen only.
        if name in tests and (name in added or seen is None or not seen.seen):
            rows.append(_measurement_candidate(closed, tests[name], name in added))
        elif seen is not None:
            rows.append(
                Candidate(
                    name=name,
                    verdict="explained" if seen.seen else "below-noise",
                    reason=seen.evidence,
                    p_screen=None,
                    gain_nm=None,
                )
            )
        elif name in closed.untestable:
            rows.append(
                Candidate(
                    name=name,
                    verdict="not-testable",
                    reason=closed.untestable[name],
                    p_screen=None,
                    gain_nm=None,
                )
            )
        else:
            rows.append(_process_candidate(closed, name, added, sets))
    return rows + [_probe_candidate(closed, test) for test in closed.probed.tests]


def _probe_candidate(closed: Closed, test: ProbeTest) -> Candidate:
    entry = next((e for e in closed.probed.added if e.probe.name == test.name), None)
    if entry is not None:
        better, count = entry.confirmation.improved
        reason = (
            f"confirmed on {better} of {count} held-out scans; gain {test.gain_nm2:.0f} nm², its control "
            f"{test.control_nm2:.0f} nm² (95 %); halves of the scans agree by {test.agreement:.2f}"
        )
        return Candidate(
            name=test.name,
            verdict="traced-to-covariate",
            reason=reason,
            p_screen=entry.p_control,
            gain_nm=entry.confirmation.gain_nm,
        )
    mse = float(closed.errors(closed.final, closed.terms).mse_nm2.mean())
    gain = math.sqrt(mse) - math.sqrt(max(mse - test.gain_nm2, 0.0))
    return Candidate(name=test.name, verdict="below-noise", reason=test.reason, p_screen=None, gain_nm=gain)


def _measurement_candidate(closed: Closed, test: MeasurementTest, added: bool) -> Candidate:
    too_few = len(closed.development) < FEWEST_SCANS
    reason = test.evidence if added else f"{test.evidence}; {test.confirmation.reason}"
    verdict: CandidateVerdict = "not-testable" if too_few else "below-noise"
    if added or test.confirmation.reason.startswith("cannot be told"):
        verdict = "confusable" if test.confusable_with else "explained"
    return Candidate(
        name=test.effect.name,
        verdict=verdict,
        reason=reason,
        p_screen=test.p_screen,
        gain_nm=test.confirmation.gain_nm,
    )


def _process_candidate(closed: Closed, name: str, added: set[str], sets: dict[str, Added]) -> Candidate:
    search = closed.search
    entry = next((a for a in search.added if a.effect.name == name), None)
    screened = search.last.get(name) or search.first.get(name)
    first = search.first.get(name)
    p = first.p if first else None
    gain = predicted_gain_nm(closed, screened) if screened else None
    verdict: CandidateVerdict
    if entry is not None:
        better, count = entry.confirmation.improved
        reason = f"confirmed on {better} of {count} held-out scans"
        gain = entry.confirmation.gain_nm
        verdict = _verdict_on(closed, entry)
        if verdict == "traced-to-covariate":
            reason += "; but what it leaves still follows the layout, so it is near the cause, not the cause"
    elif name in search.absorbed:
        verdict, reason = "absorbed", search.absorbed[name]
    elif name in sets:
        verdict = "confusable"
        reason = f"cannot be told from {sets[name].effect.name}, which was added"
    elif screened is None:
        verdict, reason = "not-testable", "not screened"
    elif len(closed.development) < FEWEST_SCANS:
        verdict = "not-testable"
        reason = f"{len(closed.development)} scans to select and confirm on, at least {FEWEST_SCANS} needed"
    elif screened.retained < SMALLEST_RETAINED:
        verdict = "not-testable"
        reason = "on these layouts it changes nothing that the base model or the per-scan terms do not"
    elif wrong := next((s for s in (screened, first) if s and s.p <= FAMILY_P and not s.in_range), None):
        verdict, reason = "contradicted", f"best value leaves the physical range: {_values(wrong)}"
    else:
        verdict, reason = "below-noise", _why_not(closed, name, screened)
    return Candidate(name=name, verdict=verdict, reason=reason, p_screen=p, gain_nm=gain)


def _why_not(closed: Closed, name: str, screened: Screened) -> str:
    search = closed.search
    first = search.first[name]
    if name in search.dropped:
        return search.dropped[name]
    detectable = f"smallest detectable about {screened.detectable}"
    if name in search.failures and screened.p <= FAMILY_P:
        return f"stands out, but is not confirmed: {search.failures[name]}"
    if screened.p <= FAMILY_P:
        return "stands out, but others gained more and none further was confirmed"
    if first.p <= FAMILY_P and search.added:
        return f"stood out at first, gone once {search.added[0].effect.name} was added; {detectable}"
    return f"no evidence (z = {screened.z:.1f}); {detectable}"


def predicted_gain_nm(closed: Closed, screened: Screened) -> float:
    """Gain in RMSE that the score test predicts for held-out scans, nm."""
    mse = float(closed.errors(closed.final, closed.terms).mse_nm2.mean())
    return math.sqrt(mse) - math.sqrt(max(mse - screened.mean_gain_nm2, 0.0))


def _values(screened: Screened) -> str:
    parameters = screened.effect.parameters
    return ", ".join(
        f"{name} {value:.3g} {parameters[name].unit}".removesuffix(" 1")
        for name, value in screened.values.items()
        if name in screened.effect.amplitudes
    )


def _shares(closed: Closed) -> Shares:
    """Parts of the base model's squared error without any fit; they sum to 1."""
    total = float(closed.errors(closed.base, _NO_TERMS).mse_nm2.mean())
    freed = min(total, float(closed.errors(closed.base, closed.terms).mse_nm2.mean()))
    named = min(freed, float(closed.errors(closed.search.state, closed.terms).mse_nm2.mean()))
    final = closed.errors(closed.final, closed.terms)
    left = min(named, float(final.mse_nm2.mean()))
    floor = min(left, closed.floor_nm[0] ** 2)
    defects = min(left - floor, _squares_in_defects_nm2(closed, final))
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


def _squares_in_defects_nm2(closed: Closed, final: Score) -> float:
    """What the pixels of localised defects add to the mean squared error, nm²."""
    parts = []
    for residual, mask in zip(final.residual_um, closed.probed.defects.masks, strict=True):
        scored = np.isfinite(residual)
        parts.append((residual[scored & mask] ** 2).sum() / max(scored.sum(), 1) * NM_PER_UM**2)
    return float(np.mean(parts))
