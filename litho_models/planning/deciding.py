"""What new prints decide: the questions of a first round, declared before the new scans are looked at.

Every rival is fitted to all prints, old and new, and judged on the new ones alone: the difference of two
squared errors, less what the form of the model may have made of it, against its standard deviation, from
blocks of pixels and, as in the plan, from what prints differ by. Scans of one print share its roughness, so
their blocks are added up before they count. A rival is excluded where another is better with p <= 0.005 and
by 1 % of its squared error; a name is given where one is left.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import f as f_distribution

from litho_data.build.gratings import GratingScan
from litho_models.effects import get_effect
from litho_models.effects.registry import TIP
from litho_models.loop.prepared import PreparedScan
from litho_models.planning.decision_error import Z_DECIDED, surely_better
from litho_models.planning.noise import left_nm
from litho_models.planning.questions import OpenQuestions, Question
from litho_models.planning.rival_fits import fit_rivals
from litho_models.scan_terms import TermPixels, least_squares, parameter_names, term_maps, terms_of_effect
from litho_models.scan_terms.lines import axis_along, shrunk_line_offsets
from litho_models.scan_terms.term import row_index
from litho_models.twin.judging import CONFIRM_P, SMALLEST_SHARE
from litho_models.twin.model import Twin
from litho_models.twin.record import CloseLoop, Comparison, Decision, FoundEffect

NONE = "none of them"
BOTH = PRINTER, MICROSCOPE = "the printer", "the microscope"
SCANNER = "piezo-nonlinearity"
_BLOCK_PX = 32
# Of the variance of a term of single scans, that of the print if the printer is its cause.
PRINT_SHARE = 0.9


@dataclass(frozen=True)
class Evidence:
    """New scans, beside those that a model is known from.

    Attributes:
        twin: the corrected model, of one strength for all scans; ``windows``: what it was fitted to.
        new: scans that were in no fit so far; ``gratings``: scanned beside them.
    """

    twin: Twin
    windows: Sequence[PreparedScan]
    new: Sequence[PreparedScan]
    gratings: Sequence[GratingScan] = ()

    def decide(
        self, open_: OpenQuestions, report: Callable[[str], None] = lambda message: None
    ) -> list[Decision]:
        """Judge every declared question that scans can answer."""
        kinds = {"lines": self._of_lines, "per-scan": self._of_single_scans}
        decisions = []
        for question in open_.questions:
            if question.kind != "fact":
                report(f"deciding on {question.name}")
                decisions.append(kinds.get(question.kind, self._among_rivals)(question))
        return decisions

    def _among_rivals(self, question: Question) -> Decision:
        bare = Twin.of_base(self.twin.base, self.twin.full_height_um, self.twin.pitch_um)
        twins = [rival.twin(bare) for rival in question.rivals]
        without = twins[0]
        for name in {rival.effect for rival in question.rivals} & {*without.names}:
            without = without.without(name)
        windows = [*self.windows, *(scan.window for scan in self.new)]
        names = [*(rival.name for rival in question.rivals), NONE]
        twins.append(without)
        left = {}
        for name, twin, fit in zip(names, twins, fit_rivals(twins, windows), strict=True):
            placed = twin.at(fit.vector).placed()
            left[name] = [left_nm(scan, placed.height(scan)) for scan in self.new]
        decision = compared(question, self.new, left)
        scan = self.new[0].stored
        said = said_by_gratings(question, self.gratings, scan.shape[1] * scan.pitch_um)
        return decision.model_copy(update={"evidence": "; ".join(filter(None, (decision.evidence, said)))})

    def _of_single_scans(self, question: Question) -> Decision:
        """Analysis of variance of a term of single scans: prints against repeats."""
        own = terms_of_effect(question.name)
        terms = own | {"offset", "gain", "bow"}
        named = parameter_names(terms)
        columns = [named.index(name) for name in parameter_names(own)]
        by_print: dict[str, list[np.ndarray]] = {}
        placed = self.twin.placed()
        for scan in self.new:
            prediction = placed.height(scan)
            maps = term_maps(TermPixels(prediction, scan.line, scan.sample), terms)
            found = least_squares(maps, scan.height - scan.at_sample(prediction))
            by_print.setdefault(scan.stored.print_id, []).append(found[columns])
        repeated = [np.array(values) for values in by_print.values() if len(values) > 1]
        between, within = len(repeated) - 1, sum(len(values) - 1 for values in repeated)
        if between < 1 or within < 1:
            return self._unseen(question, "no print was scanned twice")
        sizes = np.array([len(values) for values in repeated])[:, None]
        means = np.array([values.mean(axis=0) for values in repeated])
        centre = (sizes * means).sum(axis=0) / sizes.sum()
        ms_between = (sizes * (means - centre) ** 2).sum(axis=0) / between
        ms_within = sum(((values - values.mean(axis=0)) ** 2).sum(axis=0) for values in repeated) / within
        ratio = float(np.median(ms_between / np.maximum(ms_within, 1e-30)))
        printer = f_distribution.sf(ratio, between, within) <= CONFIRM_P
        share = 1 + float(sizes.mean()) * PRINT_SHARE / (1 - PRINT_SHARE)
        scanned = f_distribution.cdf(ratio / share, between, within) <= CONFIRM_P
        evidence = f"F({between}, {within}) = {ratio:.2f} of prints against repeats"
        return _of_owner(question, self.new, evidence, printer, scanned)

    def _of_lines(self, question: Question) -> Decision:
        """Variance of line offsets along the layout's rows and along the scan lines of turned scans."""
        turned = [scan for scan in self.new if axis_along(scan.line) == 0]
        if not turned:
            return self._unseen(question, "no scan is turned")
        placed, variances, own, lines = self.twin.placed(), [], 0.0, 0
        for scan in turned:
            used = scan.usable
            residual = scan.stored.height_um - placed.height(scan)
            residual = np.where(used, residual - residual[used].mean(), 0.0).astype(np.float64)
            variances.append(
                [
                    shrunk_line_offsets(residual, used, index, _BLOCK_PX)[2]
                    for index in (row_index(residual.shape), scan.line)
                ]
            )
            own += float(residual[used].var()) / residual.shape[1] / len(turned)
            lines += residual.shape[0]
        written, scanned = np.mean(variances, axis=0).tolist()
        z = (written - scanned) / ((written + scanned + own) * np.sqrt(2 / lines))
        evidence = (
            f"offsets vary by {1e6 * written:.1f} nm² along the layout's rows and by {1e6 * scanned:.1f} nm² "
            f"along the lines of the turned scans (z = {z:.1f})"
        )
        return _of_owner(question, turned, evidence, z >= Z_DECIDED, z <= -Z_DECIDED)

    def _unseen(self, question: Question, why: str) -> Decision:
        return _decision(question, self.new, BOTH, BOTH, why).model_copy(
            update={"verdict": "not shown by these prints"}
        )


def with_decisions(result: CloseLoop, open_: OpenQuestions, decisions: list[Decision]) -> CloseLoop:
    """The result with what was decided: an effect that is left alone is explained, and has an owner."""
    decided = {one.question: one.left[0] for one in decisions if one.verdict == "decided"}
    answers = {
        rival.effect: rival
        for question in open_.questions
        for rival in question.rivals
        if decided.get(question.name) == rival.name
    }

    def settled(effect: FoundEffect) -> FoundEffect:
        answer = answers.get(effect.name)
        if answer is None:
            return effect
        changes: dict[str, Any] = {"verdict": "explained", "confusable_with": []}
        if answer.owner is not None:
            changes["role"] = "process" if answer.owner == "printer" else "measurement"
        elif effect.role == "undetermined":
            changes["role"] = get_effect(effect.name).role
        return effect.model_copy(update=changes)

    effects = [settled(effect) for effect in result.effects]
    return result.model_copy(update={"decisions": decisions, "effects": effects})


def compared(
    question: Question, new: Sequence[PreparedScan], left_nm: Mapping[str, Sequence[np.ndarray]]
) -> Decision:
    """Judge the answers to a question by what each leaves of the new scans, maps (y, x) in nm."""
    comparisons = [_compare(a, b, left_nm, new, question) for a in left_nm for b in left_nm if a != b]
    # As in the loop: a smaller difference may come from what no rival describes.
    least = {
        name: SMALLEST_SHARE * float(np.mean([np.nanmean(one**2) for one in own]))
        for name, own in left_nm.items()
    }
    excluded = {c.worse for c in comparisons if c.z >= Z_DECIDED and c.gain_nm2 >= least[c.better]}
    names = [name for name in left_nm if name != NONE]
    left = [name for name in names if name not in excluded]
    said = "; ".join(
        f"{one.better} better than {one.worse} by {one.gain_nm2:.1f} nm² (z = {one.z:.1f})"
        for one in comparisons
        if one.better in left and one.worse != NONE and one.gain_nm2 > 0
    )
    decision = _decision(question, new, names, left, said or "no rival is better than another")
    decision = decision.model_copy(update={"comparisons": comparisons})
    if not left or (NONE not in excluded and len(left) == 1):
        return decision.model_copy(update={"verdict": "none of them"})
    if len(left) > 1 and question.form_nm is not None:
        nearest_nm = min(one.difference_nm for one in comparisons if {one.better, one.worse} <= {*left})
        evidence = (
            f"{decision.evidence}; the model's own error is {question.form_nm:.1f} nm at most, the nearest "
            f"two that are left differ by {nearest_nm:.1f} nm"
        )
        return decision.model_copy(update={"evidence": evidence})
    return decision


def _compare(
    better: str,
    worse: str,
    left_nm: Mapping[str, Sequence[np.ndarray]],
    new: Sequence[PreparedScan],
    question: Question,
) -> Comparison:
    """Squared errors of two rivals: sums over blocks of a print, their spread within and between prints."""
    by_print: dict[str, list[np.ndarray]] = {}
    pixels, difference = 0, 0.0
    for scan, good, bad in zip(new, left_nm[better], left_nm[worse], strict=True):
        pixels += int(np.isfinite(good).sum())
        difference += float(np.nansum((bad - good) ** 2))
        by_print.setdefault(scan.stored.print_id, []).append(_block_sums(bad**2 - good**2))
    total, variance = 0.0, 0.0
    for sums in by_print.values():
        together = np.sum(sums, axis=0)
        # The mean over blocks is what the print says; their spread about it is noise.
        variance += together.size * float(together.var(ddof=1))
        total += float(together.sum())
    variance += (question.spread * total) ** 2 / len(by_print)
    form = pixels * (question.form_nm or 0.0) ** 2
    return Comparison(
        better=better,
        worse=worse,
        gain_nm2=total / max(pixels, 1),
        z=surely_better(total, difference, float(np.sqrt(variance)), form),
        difference_nm=float(np.sqrt(difference / max(pixels, 1))),
    )


def _block_sums(gain: np.ndarray) -> np.ndarray:
    ny, nx = (max(2, n // _BLOCK_PX) for n in gain.shape)
    rows, columns = (np.arange(n) * blocks // n for n, blocks in zip(gain.shape, (ny, nx), strict=True))
    place = rows[:, None] * nx + columns[None, :]
    return np.bincount(place.ravel(), weights=np.nan_to_num(gain).ravel(), minlength=ny * nx)


def _of_owner(
    question: Question, scans: Sequence[PreparedScan], evidence: str, printer: bool, scanned: bool
) -> Decision:
    left = BOTH if printer == scanned else [PRINTER if printer else MICROSCOPE]
    return _decision(question, scans, BOTH, left, evidence)


def _decision(
    question: Question,
    scans: Sequence[PreparedScan],
    declared: Sequence[str],
    left: Sequence[str],
    evidence: str,
) -> Decision:
    """What these scans say of a question: decided where one answer is left."""
    return Decision(
        question=question.name,
        kind=question.kind,
        declared=list(declared),
        left=list(left),
        verdict="decided" if len(left) == 1 else "still open",
        evidence=evidence,
        prints=len({scan.stored.print_id for scan in scans}),
        scans=len(scans),
    )


def said_by_gratings(question: Question, gratings: Sequence[GratingScan], line_um: float) -> str:
    """What gratings say of a question about the scanner or the tip; empty if they say nothing of it.

    A rival asks for what the first round fitted; what the grating shows lies above half of that or below. It
    stands in the evidence and decides nothing.

    Args:
        question: with its rivals; ``line_um``: length of a line of the prints.
    """
    told = []
    for name, asked in {rival.effect: rival.effects[rival.effect] for rival in question.rivals}.items():
        for one in gratings:
            if name == TIP and one.tip_at_most_um is not None:
                told.append(
                    f"a grating shows a tip of {one.tip_at_most_um:.2f} µm at most, {TIP} asks for "
                    f"{asked['radius_um']:.2f} µm"
                )
            elif name == SCANNER and one.bow_um is not None and one.bow_sd_um is not None:
                # A displacement that is quadratic grows with the square of the line.
                scale_nm = 1e3 * (line_um / one.line_um) ** 2
                told.append(
                    f"a grating shows the middle of a line {scale_nm * one.bow_um:.1f} ± "
                    f"{scale_nm * one.bow_sd_um:.1f} nm off, {SCANNER} asks for "
                    f"{1e3 * asked['strength'] * line_um / 4:.0f} nm"
                )
    return "; ".join(told)
