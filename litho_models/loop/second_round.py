"""What new prints decide: the names and sets of a first round, declared before the new scans are looked at.

Every rival is fitted to all prints, old and new, and judged on the new ones alone: the difference of two
squared errors, less what the form of the model may have made of it, against its standard deviation, from
blocks of pixels and, as in the plan, from what prints differ by. Scans of one print share its roughness, so
their blocks are added up before they count. A rival is excluded where another is better with p <= 0.005 and
by 1 % of its squared error; a name is given where one is left.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import f as f_distribution

from litho_data.build.gratings import GratingScan
from litho_models.effects.chain import EffectChain
from litho_models.loop.decision_error import Z_DECIDED, surely_better
from litho_models.loop.findings import LoopFindings
from litho_models.loop.fold_fits import predict
from litho_models.loop.linear import ALL_FREE
from litho_models.loop.open_questions import as_scanned
from litho_models.loop.parameters import chain_at, get_vector
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.result.questions import IN_PRINT, IN_SCAN, OpenQuestions, Question, Rival, effect_of
from litho_models.loop.result.record import AddedEffect, CloseLoop, Comparison, Decided, Decision
from litho_models.loop.rival_fits import fit_rivals
from litho_models.loop.second_answer import said_by_gratings
from litho_models.loop.selection.confirming import BINOMIAL_P, SMALLEST_SHARE
from litho_models.loop.single_scans.nested_tests import scan_parameters
from litho_models.loop.study import Score, score
from litho_models.scan_terms import Terms, parameter_names, terms_of_effect
from litho_models.scan_terms.lines import axis_along, shrunk_line_offsets
from litho_models.scan_terms.term import row_index

NONE = "none of them"
BOTH = PRINTER, MICROSCOPE = "the printer", "the microscope"
_BLOCK_PX = 32
_SHARE = 0.9


def decide(
    findings: LoopFindings,
    open_: OpenQuestions,
    new: Sequence[PreparedScan],
    report: Callable[[str], None] = lambda message: None,
    gratings: Sequence[GratingScan] = (),
) -> list[Decision]:
    """Judge every declared question on the new scans.

    Args:
        findings: of the first round.
        open_: what it declared; ``new``: scans that were in no fit so far.
        gratings: scanned beside them; what they say stands in the evidence, and decides nothing.
    """
    decisions = []
    for question in open_.questions:
        if question.kind == "fact":
            continue
        report(f"deciding on {question.name}")
        if len(question.rivals) > 1:
            decision = _among_rivals(findings, question, new)
            line_um = new[0].stored.shape[1] * new[0].stored.pitch_um
            said = said_by_gratings(question, gratings, line_um)
            evidence = "; ".join(filter(None, (decision.evidence, said)))
            decisions.append(decision.model_copy(update={"evidence": evidence}))
        elif question.kind == "generic":
            decisions.append(_of_generic(findings, question, new))
        elif question.kind == "lines":
            decisions.append(_of_lines(findings, question, new))
        else:
            decisions.append(_of_single_scans(findings, question, new))
    return decisions


def with_decisions(result: CloseLoop, decisions: list[Decision]) -> CloseLoop:
    """The result with what was decided: an effect that is left alone is explained, and has an owner."""
    named = {one.question: one.left[0] for one in decisions if one.verdict == "decided" and one.left}

    def decided(effect: AddedEffect) -> AddedEffect:
        left = named.get(effect.name, "")
        if effect_of(left) != effect.name:
            return effect
        changes: dict[str, Any] = {"verdict": "explained", "confusable_with": []}
        if effect.role == "undetermined":
            changes["role"] = "measurement" if left.endswith(IN_SCAN) else "process"
        elif left.endswith(IN_PRINT):
            changes["role"] = "process"
        return effect.model_copy(update=changes)

    return result.model_copy(
        update={"decisions": decisions, "effects": [decided(effect) for effect in result.effects]}
    )


def _among_rivals(findings: LoopFindings, question: Question, new: Sequence[PreparedScan]) -> Decision:
    own = {effect_of(rival.name) for rival in question.rivals}
    names = [rival.name for rival in question.rivals]
    chains = [_chain(findings, rival) for rival in question.rivals]
    starts = [np.array(rival.vector) for rival in question.rivals]
    without = _chain(findings, question.rivals[0], without=own)
    windows = [scan.window for scan in (*findings.development, *new)]
    chains, starts = [*chains, without], [*starts, get_vector(without)]
    predictions = {}
    for name, chain, vector in zip((*names, NONE), chains, fit_rivals(chains, starts, windows), strict=True):
        fitted = chain_at(chain, vector)
        predictions[name] = [predict(fitted, get_vector(fitted), scan) for scan in new]
    return _decision(question, new, predictions, names, findings)


def _chain(findings: LoopFindings, rival: Rival, *, without: Collection[str] = ()) -> EffectChain:
    """The rival's effects on the base of the first round; ``without``: those that are left out."""
    chain = findings.search.state.fits.chain
    kept = {name: own for name, own in rival.effects.items() if name not in without}
    return EffectChain(
        chain.base,
        kept,
        full_height_um=chain.full_height_um,
        pitch_um=chain.pitch_um,
        scan_frame=[name for name in rival.scan_frame if name in kept],
        print_frame=[name for name in rival.print_frame if name in kept],
    )


def _of_generic(findings: LoopFindings, question: Question, new: Sequence[PreparedScan]) -> Decision:
    entry = next(e for e in findings.probed.added if e.probe.name == question.name)
    fits, common = findings.final.fits, entry.estimate.common
    first_of = {scan.stored.print_id: scan.context.order for scan in reversed(new)}
    predictions: dict[str, list[np.ndarray]] = {PRINTER: [], MICROSCOPE: [], NONE: []}
    for scan in new:
        plain = predict(fits.chain, fits.common, scan)
        printed = replace(scan, context=replace(scan.context, order=first_of[scan.stored.print_id]))
        late = question.turning is not None and question.turning.by != "turned scan"
        correct = entry.probe.correction
        scanned = correct(common, scan, plain) if late else as_scanned(entry.probe, common, scan, plain)
        predictions[NONE].append(plain)
        predictions[PRINTER].append(plain + correct(common, printed, plain))
        predictions[MICROSCOPE].append(plain + scanned)
    return _decision(question, new, predictions, [PRINTER, MICROSCOPE], findings)


def _decision(
    question: Question,
    new: Sequence[PreparedScan],
    predictions: Mapping[str, Sequence[np.ndarray]],
    names: Sequence[str],
    findings: LoopFindings,
) -> Decision:
    scores = {name: score(new, own, ALL_FREE, findings.study.blocks) for name, own in predictions.items()}
    comparisons = [_compare(a, b, scores, new, question) for a in scores for b in scores if a != b]
    # As in the loop: a smaller difference may come from what no rival describes.
    least = {name: SMALLEST_SHARE * float(own.mse_nm2.mean()) for name, own in scores.items()}
    excluded = {c.worse for c in comparisons if c.z >= Z_DECIDED and c.gain_nm2 >= least[c.better]}
    left = [name for name in names if name not in excluded]
    evident = [one for one in comparisons if one.better in left and one.worse != NONE and one.gain_nm2 > 0]
    if not left or (NONE not in excluded and len(left) <= 1):
        verdict: Decided = "none of them"
    elif len(left) == 1:
        verdict = "decided"
    else:
        verdict = "still open"
    said = "; ".join(
        f"{one.better} better than {one.worse} by {one.gain_nm2:.1f} nm² (z = {one.z:.1f})" for one in evident
    )
    evidence = said or "no rival is better than another"
    declared = [one for one in comparisons if NONE not in (one.better, one.worse)]
    if verdict == "still open" and question.form_nm is not None:
        nearest_nm = min(one.difference_nm or 0.0 for one in declared if {one.better, one.worse} <= {*left})
        evidence += (
            f"; the model's own error is {question.form_nm:.1f} nm at most, the nearest two that are left "
            f"differ by {nearest_nm:.1f} nm"
        )
    return _answer(question, new, evidence, left, verdict, names, comparisons)


def _compare(
    better: str, worse: str, scores: Mapping[str, Score], new: Sequence[PreparedScan], question: Question
) -> Comparison:
    """Squared errors of two rivals: sums over blocks of a print, their spread within and between prints."""
    by_print: dict[str, list[np.ndarray]] = {}
    pixels, difference = 0, 0.0
    for scan, good, bad in zip(new, scores[better].residual_um, scores[worse].residual_um, strict=True):
        gain = 1e6 * (bad**2 - good**2)
        pixels += int(np.isfinite(gain).sum())
        difference += 1e6 * float(np.nansum((bad - good) ** 2))
        by_print.setdefault(scan.stored.print_id, []).append(_block_sums(gain))
    total, variance = 0.0, 0.0
    for sums in by_print.values():
        together = np.sum(sums, axis=0)
        # The mean over blocks is what the print says; their spread about it is noise.
        variance += together.size * float(together.var(ddof=1)) if together.size > 1 else 0.0
        total += float(together.sum())
    variance += (question.spread * total) ** 2 / len(by_print)
    count, form_nm = max(pixels, 1), question.form_nm
    return Comparison(
        better=better,
        worse=worse,
        gain_nm2=total / count,
        z=surely_better(total, difference, float(np.sqrt(variance)), count * (form_nm or 0.0) ** 2),
        difference_nm=float(np.sqrt(difference / count)),
        form_nm=form_nm,
    )


def _block_sums(gain: np.ndarray) -> np.ndarray:
    ny, nx = (max(1, n // _BLOCK_PX) for n in gain.shape)
    rows = np.minimum(np.arange(gain.shape[0]) // _BLOCK_PX, ny - 1)
    columns = np.minimum(np.arange(gain.shape[1]) // _BLOCK_PX, nx - 1)
    place = rows[:, None] * nx + columns[None, :]
    return np.bincount(place.ravel(), weights=np.nan_to_num(gain).ravel(), minlength=ny * nx)


def _of_single_scans(findings: LoopFindings, question: Question, new: Sequence[PreparedScan]) -> Decision:
    """Analysis of variance of a term of single scans: prints against repeats."""
    fits = findings.final.fits
    predictions = [predict(fits.chain, fits.common, scan) for scan in new]
    terms: Terms = frozenset({"offset", "gain", "bow"}) | terms_of_effect(question.name)
    own = terms_of_effect(question.name)
    values = scan_parameters(new, predictions, terms)
    named = parameter_names(terms)
    columns = [named.index(name) for name in parameter_names(own)]
    prints = [scan.stored.print_id for scan in new]
    groups = [[i for i, p in enumerate(prints) if p == one] for one in dict.fromkeys(prints)]
    repeated = [group for group in groups if len(group) > 1]
    between, within = len(repeated) - 1, sum(len(group) - 1 for group in repeated)
    if between < 1 or within < 1:
        return _answer(question, new, "no print was scanned twice", BOTH, "not shown by these prints")
    data = values[:, columns]
    means = np.array([data[g].mean(axis=0) for g in repeated])
    sizes = np.array([len(g) for g in repeated])[:, None]
    centre = (sizes * means).sum(axis=0) / sizes.sum()
    ms_between = (sizes * (means - centre) ** 2).sum(axis=0) / between
    ms_within = sum(((data[g] - data[g].mean(axis=0)) ** 2).sum(axis=0) for g in repeated) / within
    ratio = float(np.median(ms_between / np.maximum(ms_within, 1e-30)))
    scans = float(sizes.mean())
    printer = f_distribution.sf(ratio, between, within) <= BINOMIAL_P
    share = 1 + scans * _SHARE / (1 - _SHARE)
    scanned = f_distribution.cdf(ratio / share, between, within) <= BINOMIAL_P
    left = [PRINTER] if printer and not scanned else [MICROSCOPE] if scanned and not printer else BOTH
    return _answer(question, new, f"F({between}, {within}) = {ratio:.2f} of prints against repeats", left)


def _of_lines(findings: LoopFindings, question: Question, new: Sequence[PreparedScan]) -> Decision:
    """Variance of line offsets along the layout's rows and along the scan lines of turned scans."""
    turned = [scan for scan in new if axis_along(scan.line) == 0]
    if not turned:
        return _answer(question, new, "no scan is turned", BOTH, "not shown by these prints")
    fits = findings.final.fits
    written, scanned, lines, own = 0.0, 0.0, 0, 0.0
    for scan in turned:
        residual = scan.stored.height_um - predict(fits.chain, fits.common, scan)
        used = scan.usable
        residual = np.where(used, residual - residual[used].mean(), 0.0).astype(np.float64)
        rows = row_index(residual.shape)
        written += shrunk_line_offsets(residual, used, rows, _BLOCK_PX)[2]
        scanned += shrunk_line_offsets(residual, used, scan.line, _BLOCK_PX)[2]
        own += float(residual[used].var()) / residual.shape[1]
        lines += residual.shape[0]
    z = (written - scanned) / ((written + scanned + own) * np.sqrt(2 / lines))
    left = [PRINTER] if z >= Z_DECIDED else [MICROSCOPE] if z <= -Z_DECIDED else BOTH
    evidence = (
        f"offsets vary by {1e6 * written / len(turned):.1f} nm² along the layout's rows and by "
        f"{1e6 * scanned / len(turned):.1f} nm² along the lines of the turned scans (z = {z:.1f})"
    )
    return _answer(question, turned, evidence, left)


def _answer(
    question: Question,
    scans: Sequence[PreparedScan],
    evidence: str,
    left: Sequence[str],
    verdict: Decided | None = None,
    declared: Sequence[str] = BOTH,
    comparisons: Sequence[Comparison] = (),
) -> Decision:
    """What these scans say of a question; decided, unless stated otherwise, where one answer is left."""
    return Decision(
        question=question.name,
        kind=question.kind,
        declared=list(declared),
        left=list(left),
        verdict=verdict or ("decided" if len(left) == 1 else "still open"),
        evidence=evidence,
        prints=len({scan.stored.print_id for scan in scans}),
        scans=len(scans),
        comparisons=list(comparisons),
    )
