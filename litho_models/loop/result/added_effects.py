"""What was added, in the words of the result: verdict, estimates with intervals, errors before and after."""

from __future__ import annotations

import math
from typing import Any

from litho_models.effects import Effect
from litho_models.loop.findings import LoopFindings
from litho_models.loop.parameters import effect_slots
from litho_models.loop.probes import AddedProbe, with_intervals
from litho_models.loop.result.record import AddedEffect, EffectVerdict, ParameterEstimate
from litho_models.loop.selection.contest import Added
from litho_models.loop.selection.search import separating_experiment
from litho_models.loop.single_scans.nested_tests import MeasurementTest
from litho_models.scoring.pairs import over_prints


def added_effects(findings: LoopFindings) -> list[AddedEffect]:
    """Measurement terms seen from the start, then the process effects, then terms seen only after them."""
    first = {t.effect.name: t for t in findings.first_tests if t.confirmation.passed}
    last = {t.effect.name: t for t in findings.last_tests if t.confirmation.passed}
    early = [_added_measurement(findings, first[name]) for name in first if name in last]
    late = [_added_measurement(findings, last[name]) for name in last if name not in first]
    process = [_added_process(findings, entry) for entry in findings.search.added]
    return early + process + [_added_probe(findings, entry) for entry in findings.probed.added] + late


def _added_measurement(findings: LoopFindings, test: MeasurementTest) -> AddedEffect:
    effect = test.effect
    return AddedEffect(
        name=effect.name,
        stage=effect.stage,
        role=test.role,
        verdict="confusable" if test.confusable_with else "explained",
        by_print=test.by_print,
        prior_hypothesis=effect.name in findings.config.prior_hypotheses,
        parameters={
            name if name.startswith("sd") else f"{name}_sd_between_scans": ParameterEstimate(
                value=value, unit=unit, ci95=interval
            )
            for name, (value, interval, unit) in test.spread.items()
        },
        metric="mae_abs" if effect.name == "datum-offset" else "mae_datum_free",
        p_screen=test.p_screen,
        confusable_with=list(test.confusable_with),
        separating_experiment=effect.separating,
        **_evidence(findings, test),
    )


def verdict_on(findings: LoopFindings, entry: Added) -> EffectVerdict:
    """Of an added effect: a cause, one of a set, or a part of what is missing."""
    if findings.weights[entry.effect.name].lacking:
        return "partial"
    return "confusable" if entry.confusable_with else "explained"


def _added_process(findings: LoopFindings, entry: Added) -> AddedEffect:
    effect, verdict = entry.effect, verdict_on(findings, entry)
    return AddedEffect(
        name=effect.name,
        stage=effect.stage,
        role="undetermined" if verdict == "partial" else effect.role,
        verdict=verdict,
        prior_hypothesis=effect.name in findings.config.prior_hypotheses,
        parameters=_parameter_estimates(findings, effect),
        metric="mae_datum_free",
        p_screen=entry.p_screen,
        confusable_with=entry.confusable_with,
        separating_experiment=separating_experiment([effect.name, *entry.confusable_with]),
        share=findings.weights[effect.name].share,
        **_evidence(findings, entry),
    )


def _added_probe(findings: LoopFindings, entry: AddedProbe) -> AddedEffect:
    """A generic term: where the residual lives, added to the height; never a cause."""
    return AddedEffect(
        name=entry.probe.name,
        stage="development",
        role="undetermined",
        verdict="traced-to-covariate",
        prior_hypothesis=False,
        parameters={
            name: ParameterEstimate(value=value, unit=unit, ci95=interval)
            for name, (value, unit, interval) in with_intervals(entry.probe, entry.estimate).items()
        },
        metric="mae_datum_free",
        p_screen=entry.p_control,
        confusable_with=[],
        separating_experiment="print and scan the same layouts turned by 90 degrees",
        **_evidence(findings, entry),
    )


def _evidence(findings: LoopFindings, found: Added | MeasurementTest | AddedProbe) -> dict[str, Any]:
    """Errors before and after, terms per scan on both sides, and the gain over scans and over prints."""
    before, after, confirmation = found.before, found.after, found.confirmation
    gains = (before.mae_nm - after.mae_nm).tolist()
    return {
        "before_nm": before.mean_mae_nm,
        "after_nm": after.mean_mae_nm,
        "gain_ci95_nm": confirmation.gain_ci95_nm,
        "p_confirm": confirmation.p,
        "scans_improved": confirmation.improved,
        "terms_per_scan": (before.degrees_of_freedom, after.degrees_of_freedom),
        "over_prints": over_prints(gains, findings.prints, findings.config.seed),
    }


def _parameter_estimates(findings: LoopFindings, effect: Effect) -> dict[str, ParameterEstimate]:
    """Final values on all development scans, intervals from the spread over scans; choices have none."""
    from scipy.stats import t

    fits = findings.final.fits
    slots = effect_slots(fits.chain)
    reach = float(t.ppf(0.975, max(len(findings.development) - 1, 1)))
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
