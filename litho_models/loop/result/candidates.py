"""Every effect that was looked at, added or not: its verdict and the reason in a sentence."""

from __future__ import annotations

import math

from litho_models.effects import CATALOGUE
from litho_models.loop.findings import LoopFindings
from litho_models.loop.probes import ProbeTest
from litho_models.loop.result.added_effects import verdict_on
from litho_models.loop.result.record import Candidate, CandidateVerdict
from litho_models.loop.screening.score_test import FAMILY_P, SMALLEST_RETAINED, Screened
from litho_models.loop.selection.confirming import FEWEST_SCANS
from litho_models.loop.selection.contest import Added
from litho_models.loop.single_scans.nested_tests import MeasurementTest


def all_candidates(findings: LoopFindings, added: set[str]) -> list[Candidate]:
    rows = []
    tests = {t.effect.name: t for t in findings.first_tests} | {t.effect.name: t for t in findings.last_tests}
    sets = {name: entry for entry in findings.search.added for name in entry.confusable_with}
    for name in [*CATALOGUE, *(n for n in findings.untestable if n not in CATALOGUE)]:
        seen = findings.observed.get(name)
        # A term of single scans is one form of an effect; what is shorter, or already mended, is seen only.
        if name in tests and (name in added or seen is None or not seen.seen):
            rows.append(_measurement_candidate(findings, tests[name], name in added))
        elif seen is not None:
            verdict: CandidateVerdict = "explained" if seen.seen else "below-noise"
            rows.append(Candidate(name=name, verdict=verdict, reason=seen.evidence))
        elif name in findings.untestable:
            rows.append(Candidate(name=name, verdict="not-testable", reason=findings.untestable[name]))
        else:
            rows.append(_process_candidate(findings, name, sets))
    return rows + [_probe_candidate(findings, test) for test in findings.probed.tests]


def _probe_candidate(findings: LoopFindings, test: ProbeTest) -> Candidate:
    entry = next((e for e in findings.probed.added if e.probe.name == test.name), None)
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
    gain = _predicted_gain_nm(findings, test.gain_nm2)
    return Candidate(name=test.name, verdict="below-noise", reason=test.reason, gain_nm=gain)


def _measurement_candidate(findings: LoopFindings, test: MeasurementTest, added: bool) -> Candidate:
    too_few = len(findings.development) < FEWEST_SCANS
    reason = test.evidence if added else f"{test.evidence}; {test.confirmation.reason}"
    verdict: CandidateVerdict = "not-testable" if too_few else "below-noise"
    if added or test.confirmation.reason.startswith("cannot be distinguished"):
        verdict = "confusable" if test.confusable_with else "explained"
    return Candidate(
        name=test.effect.name,
        verdict=verdict,
        reason=reason,
        p_screen=test.p_screen,
        gain_nm=test.confirmation.gain_nm,
    )


def _process_candidate(findings: LoopFindings, name: str, sets: dict[str, Added]) -> Candidate:
    search = findings.search
    entry = next((a for a in search.added if a.effect.name == name), None)
    screened = search.last.get(name) or search.first.get(name)
    first = search.first.get(name)
    p = first.p if first else None
    gain = _predicted_gain_nm(findings, screened.mean_gain_nm2) if screened else None
    verdict: CandidateVerdict
    if entry is not None:
        better, count = entry.confirmation.improved
        reason = f"confirmed on {better} of {count} held-out scans"
        gain = entry.confirmation.gain_nm
        verdict = verdict_on(findings, entry)
        if verdict == "partial":
            reason += f"; but only a part of what is missing: {findings.weights[name].lacking}"
    elif name in search.absorbed:
        verdict, reason = "absorbed", search.absorbed[name]
    elif name in sets:
        verdict = "confusable"
        reason = f"cannot be distinguished from {sets[name].effect.name}, which was added"
    elif screened is None:
        verdict, reason = "not-testable", "not screened"
    elif len(findings.development) < FEWEST_SCANS:
        verdict = "not-testable"
        reason = f"{len(findings.development)} scans to select and confirm on, at least {FEWEST_SCANS} needed"
    elif screened.retained < SMALLEST_RETAINED <= screened.beside_base:
        verdict, reason = "absorbed", "parameters of the base model do the same: its fit has taken it up"
    elif screened.retained < SMALLEST_RETAINED:
        verdict = "not-testable"
        reason = "on these layouts it changes nothing that the terms of single scans do not"
    elif wrong := next((s for s in (screened, first) if s and s.p <= FAMILY_P and not s.in_range), None):
        verdict, reason = "contradicted", f"best value leaves the physical range: {_values(wrong)}"
    else:
        verdict, reason = "below-noise", _why_not(findings, name, screened)
    return Candidate(name=name, verdict=verdict, reason=reason, p_screen=p, gain_nm=gain)


def _why_not(findings: LoopFindings, name: str, screened: Screened) -> str:
    search = findings.search
    first = search.first[name]
    if name in search.dropped:
        return search.dropped[name]
    detectable = f"smallest detectable about {screened.detectable}"
    if name in search.failures and screened.p <= FAMILY_P:
        return f"stands out, but is not confirmed: {search.failures[name]}"
    if screened.p <= FAMILY_P:
        return "stands out, but others gained more and none of the rest was confirmed"
    if first.p <= FAMILY_P and search.added:
        return f"stood out at first, gone once {search.added[0].effect.name} was added; {detectable}"
    return f"no evidence (z = {screened.z:.1f}); {detectable}"


def _predicted_gain_nm(findings: LoopFindings, gain_nm2: float) -> float:
    """Gain in RMSE on held-out scans, nm, from the predicted one in squared error."""
    mse = float(findings.errors(findings.final, findings.terms).mse_nm2.mean())
    return math.sqrt(mse) - math.sqrt(max(mse - gain_nm2, 0.0))


def _values(screened: Screened) -> str:
    parameters = screened.effect.parameters
    return ", ".join(
        f"{name} {value:.3g} {parameters[name].unit}".removesuffix(" 1")
        for name, value in screened.values.items()
        if name in screened.effect.amplitudes
    )
