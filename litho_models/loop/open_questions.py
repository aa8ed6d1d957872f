"""What a closed loop leaves open, with everything that an experiment needs to be planned from it.

A set that the prints cannot tell apart is kept as rivals: the base model with each member in turn, fitted
again to all scans. A generic term of unknown role is kept as two: it goes with the print, or with the scan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import CATALOGUE, get_effect
from litho_models.effects.registry import TIP
from litho_models.fitting.least_squares import eliminated_sum
from litho_models.loop.explainable import GENERIC_TERMS, Learner
from litho_models.loop.findings import LoopFindings
from litho_models.loop.fold_fits import TERM_WEIGHT, ChainProblem, predict, robust_covariance
from litho_models.loop.linear import ALL_FREE, without_scan_terms
from litho_models.loop.parameters import chain_at, get_vector
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes import AddedProbe
from litho_models.loop.probes.layout import LAYOUT_FEATURES
from litho_models.loop.probes.probe import Probe
from litho_models.loop.residual_spectrum import NoiseSpectrum, residual_spectrum
from litho_models.loop.result.questions import (
    IN_PRINT,
    IN_SCAN,
    Doing,
    OpenQuestions,
    Question,
    Rival,
    Turning,
)
from litho_models.loop.result.record import CloseLoop
from litho_models.loop.rival_fits import fit_rivals
from litho_models.loop.screening.score_test import FAMILY_P, Screened
from litho_models.loop.selection.contest import fitting_start
from litho_models.loop.study import Score

# Suspects: how many, and the least gain that one promises, as a share of the squared error.
_MOST_SUSPECTS = 3
_LEAST_GAIN = 0.003


def open_questions(
    findings: LoopFindings,
    result: CloseLoop,
    level_share: Sequence[float],
    report: Callable[[str], None] = lambda message: None,
) -> OpenQuestions:
    """Everything open in a result, the most valuable first, rivals fitted."""
    first = findings.development[0].stored
    noise = residual_spectrum(findings.development, findings.final.predictions)
    frequency, power = _layout_spectrum(findings.development)
    questions = [
        *(
            q
            for entry in findings.search.added
            for q in _of_named(findings, entry.effect.name, noise, report)
        ),
        *_suspects(findings, report),
        *(_of_generic(findings, entry, noise) for entry in findings.probed.added),
        *_of_single_scans(result),
        *_of_facts(findings),
    ]
    return OpenQuestions(
        dataset=result.dataset,
        n_scans=len(findings.development),
        field_px=first.shape,
        noise=noise,
        level_share=list(level_share),
        power_share=power,
        frequency_per_um=frequency,
        write_field_um=(first.write or {}).get("field_um"),
        questions=[q for q in questions if q is not None],
    )


def _layout_spectrum(scans: Sequence[PreparedScan]) -> tuple[list[float], list[float]]:
    from litho_data.layouts.statistics import layout_statistics

    first = scans[0].stored
    if min(min(scan.stored.shape) for scan in scans) < 64:
        return [0.25, 0.5], [1.0, 0.0]
    known = layout_statistics(
        [scan.stored.mask_level for scan in scans], levels=first.levels, pitch_um=first.pitch_um
    )
    return known.frequency_per_um, known.power_share


def _of_named(
    findings: LoopFindings, name: str, noise: NoiseSpectrum, report: Callable[[str], None]
) -> list[Question]:
    """The set of a named effect, or whose it is."""
    entry = next(a for a in findings.search.added if a.effect.name == name)
    members = [other for other in entry.confusable_with if not get_effect(other).per_scan]
    either = len(_frames(name, findings.search.state.fits.chain.values()[name])) > 1
    if not members and not either:
        return []
    report(f"fitting the rivals of {name}")
    rivals = _rivals(findings, name, [name, *members])
    names = ", ".join(rival.name for rival in rivals)
    text = f"which of these it is: {names}" if members else f"whose it is: {names}"
    texts = [get_effect(member).separating for member in (name, *members)]
    # Rivals are judged without generic terms.
    terms = (GENERIC_TERMS, LAYOUT_FEATURES)
    rests = [rest for stage, rest in findings.explainable.items() if stage not in terms]
    return [
        Question(
            name=name,
            kind="set" if members else "role",
            text=text,
            experiment="; ".join(dict.fromkeys(filter(None, texts))),
            rivals=rivals,
            spread=_spread(entry.before, entry.after, noise),
            form_nm=rests[-1].most_nm,
        )
    ]


def _suspects(findings: LoopFindings, report: Callable[[str], None]) -> list[Question]:
    """Effects that stand out and were not confirmed: which of them carries what is left, if any."""
    search = findings.search
    mse = float(findings.errors(search.state, findings.terms).mse_nm2.mean())
    standing = [
        s
        for s in search.last.values()
        if s.p <= FAMILY_P
        and s.in_range
        and s.mean_gain_nm2 >= _LEAST_GAIN * mse
        # What acts as bow or gain of single scans is seen by other means than its shape.
        and s.projection == "full"
        and s.effect.name not in search.names
    ]
    standing.sort(key=lambda s: -s.mean_gain_nm2)
    if len(standing) < 2 and not any(s.effect.role == "undetermined" for s in standing):
        return []
    names = [s.effect.name for s in standing[:_MOST_SUSPECTS]]
    report(f"fitting the suspects {', '.join(names)}")
    texts = [get_effect(name).separating for name in names]
    rivals = _rivals(findings, None, names)
    return [
        Question(
            name=" or ".join(names),
            kind="suspects",
            text="each stands out and none was confirmed: which of these carries it",
            experiment="; ".join(dict.fromkeys(filter(None, texts))),
            rivals=rivals,
            form_nm=_left_by_suspects(findings, rivals),
        )
    ]


def _left_by_suspects(findings: LoopFindings, rivals: Sequence[Rival]) -> float:
    """The error of the form beside the best of them, nm: the loop measured it with none of them in."""
    learner = Learner(findings.study, findings.base.predictions)
    chain, rests = findings.search.state.fits.chain, []
    for rival in rivals:
        if not rival.scan_frame:
            fitted = chain_at(chain.with_effects(rival.effects), np.array(rival.vector))
            vector = np.array(rival.vector)
            rests.append(learner.rest([predict(fitted, vector, scan) for scan in findings.development]))
    return min(rest.most_nm for rest in rests)


def _rivals(findings: LoopFindings, replaced: str | None, names: Sequence[str]) -> list[Rival]:
    chain = findings.search.state.fits.chain
    kept = {name: own for name, own in chain.values().items() if name != replaced}
    windows = [scan.window for scan in findings.development]
    stands_for = sum(int(w.usable.sum()) for w in windows) / sum(len(w.sample) for w in windows)
    started = [
        chain.with_effects(
            {**kept, name: chain.values().get(name) or fitting_start(_screened(findings, name, replaced))}
        )
        for name in names
    ]
    vectors = fit_rivals(started, [get_vector(one) for one in started], windows)
    rivals = []
    for name, own, vector in zip(names, started, vectors, strict=True):
        linear = ChainProblem(own, windows).linearise(vector)
        effects = chain_at(own, vector).values()
        rivals += [
            Rival(
                name=name + suffix,
                effects=effects,
                scan_frame=[name] * (suffix == IN_SCAN),
                print_frame=[name] * (suffix == IN_PRINT),
                vector=vector.tolist(),
                information=(stands_for * eliminated_sum(linear, TERM_WEIGHT)[0]).tolist(),
                covariance=robust_covariance(linear).tolist(),
            )
            for suffix in _frames(name, effects[name])
        ]
    return rivals


def _frames(name: str, values: Mapping[str, float]) -> list[str]:
    """What an effect is called as whose it may be: none, or two names where one orientation cannot say.

    A tip that is sharper along one axis looks as a print whose flanks stand proud along one.
    """
    if name == TIP and values["along"] != values["across"]:
        return ["", IN_PRINT]
    return ["", IN_SCAN] if get_effect(name).role == "undetermined" else [""]


def _screened(findings: LoopFindings, name: str, replaced: str | None) -> Screened:
    """Where a rival starts: beside what was added, or in the place of one of it as before any was."""
    search = findings.search
    return search.first[name] if replaced or name not in search.last else search.last[name]


def _spread(before: Score, after: Score, noise: NoiseSpectrum) -> float:
    """How much the evidence for a change varies over scans, relative to its mean, beyond what noise does.

    Each scan says by which multiple a it wants the change d; the difference of its squared errors is
    |d|² (2 a - 1) beside the noise, so that it varies by twice the spread of a.
    """
    multiples, own = [], []
    for left, right in zip(before.residual_um, after.residual_um, strict=True):
        known = np.isfinite(left) & np.isfinite(right)
        change = np.where(known, left - right, 0.0)
        size = float((change**2).sum())
        if size:
            multiples.append(float((change * np.where(known, left, 0.0)).sum()) / size)
            own.append((noise.along(change) / NM_PER_UM) ** 2 / size)
    if len(multiples) < 2:
        return 0.0
    # Robust: a scan may have a defect.
    spread = float(np.median(np.abs(np.array(multiples) - np.median(multiples)))) / 0.6745
    return min(2 * float(np.sqrt(max(spread**2 - float(np.median(own)), 0.0))), 1.0)


def _of_generic(findings: LoopFindings, entry: AddedProbe, noise: NoiseSpectrum) -> Question:
    """A generic term: the same correction, turned with the scan or late in the order."""
    late = entry.probe.name.startswith("order-")
    rms, along, pixels = [], [], []
    for scan, prediction in zip(findings.development, findings.final.predictions, strict=True):
        own = entry.probe.correction(entry.estimate.common, scan, prediction)
        if late:
            early, end = (replace(scan, context=replace(scan.context, order=place)) for place in (-0.5, 0.5))
            corrections = [
                entry.probe.correction(entry.estimate.common, one, prediction) for one in (early, end)
            ]
            difference = corrections[1] - corrections[0]
        else:
            by = replace(scan, context=replace(scan.context, quarter_turns=1))
            difference = as_scanned(entry.probe, entry.estimate.common, by, prediction) - own
        freed = np.zeros_like(difference).reshape(-1)
        freed[scan.sample] = without_scan_terms(scan.at_sample(difference), scan, prediction, ALL_FREE)
        n = len(scan.sample)
        rms.append(float(freed @ freed) / n)
        along.append(noise.along(np.where(scan.usable, difference - difference.mean(), 0.0)))
        pixels.append(int(scan.usable.sum()))
    size_nm = NM_PER_UM * float(np.sqrt(np.mean(rms)))
    what: Doing = "early print scanned late" if late else "turned scan"
    return Question(
        name=entry.probe.name,
        kind="generic",
        text=f"{entry.probe.name} has no name: does it go with the print or with the scan",
        experiment="scan the first print again after the last"
        if late
        else "scan each print at 0 and 90 degrees",
        turning=Turning(by=what, rms_nm=size_nm, noise_nm=float(np.mean(along)), pixels=int(np.mean(pixels))),
        spread=_spread(entry.before, entry.after, noise),
        form_nm=findings.rest.most_nm,
    )


def as_scanned(
    probe: Probe, parameters: np.ndarray, scan: PreparedScan, prediction: np.ndarray
) -> np.ndarray:
    """A generic term's correction (y, x), µm, if it goes with the axes of the scan and not of the layout."""
    turns = scan.context.quarter_turns
    if not turns:
        return probe.correction(parameters, scan, prediction)
    seen = np.ascontiguousarray(np.rot90(prediction, turns))
    return np.rot90(probe.correction(parameters, _turned(scan, turns), seen), -turns)


def _turned(scan: PreparedScan, turns: int) -> PreparedScan:
    """The scan on axes turned by so many quarters."""
    import torch

    stored = replace(
        scan.stored,
        mask_level=np.ascontiguousarray(np.rot90(scan.stored.mask_level, turns)),
        height_um=np.ascontiguousarray(np.rot90(scan.stored.height_um, turns)),
        valid=np.ascontiguousarray(np.rot90(scan.stored.valid, turns)),
    )
    layout = torch.rot90(scan.layout, turns, (-2, -1)).contiguous()
    usable = np.ascontiguousarray(np.rot90(scan.usable, turns))
    sampled = np.zeros(scan.usable.size, bool)
    sampled[scan.sample] = True
    lattice = np.rot90(sampled.reshape(scan.usable.shape), turns)
    sample = np.flatnonzero(lattice)
    height = stored.height_um.reshape(-1)[sample].astype(np.float64)
    line = np.broadcast_to(np.arange(usable.shape[0])[:, None], usable.shape)
    context = replace(scan.context, layout_um=layout, scan_line=torch.from_numpy(line.copy()))
    return PreparedScan(stored, layout, context, usable, sample, height, line)


def _of_single_scans(result: CloseLoop) -> list[Question]:
    """Terms of single scans whose owner is not known, and offsets of lines."""
    found = []
    for effect in result.effects:
        if effect.name not in CATALOGUE or not get_effect(effect.name).per_scan:
            continue
        lines = effect.name in ("line-roughness", "scan-line-stripes")
        if effect.role != "undetermined" and not (lines and effect.confusable_with):
            continue
        found.append(
            Question(
                name=effect.name,
                kind="lines" if lines else "per-scan",
                text="written or scanned: offsets of lines"
                if lines
                else "differs between prints: the printer's or the microscope's",
                experiment=effect.separating_experiment,
                sizes={name: own.value for name, own in effect.parameters.items()},
            )
        )
    return found


def _of_facts(findings: LoopFindings) -> list[Question]:
    """Effects that could not be tested for want of a fact about the prints."""
    write = findings.development[0].stored.write or {}
    reasons = {name: why for name, why in findings.untestable.items() if name in CATALOGUE}
    if "field_um" not in write:
        for name in ("vignetting", "field-curvature"):
            reasons.setdefault(name, "the place of the prints in the write field is not known")
    return [
        Question(name=name, kind="fact", text=why, experiment=get_effect(name).separating)
        for name, why in reasons.items()
    ]
