"""Run a loop, write its open questions, and decide these questions with later prints of the same printer.

Every rival (competing explanation) is fitted to all prints, old and new, and judged only on the new prints.
For each pair of rivals, the difference of their squared errors is computed. An allowance for the error of the
model itself is subtracted from this difference, and the result is divided by its standard deviation. The
standard deviation is estimated from the scatter over blocks of pixels and, as in the plan, from the spread
between prints. All scans of a print show the same roughness, so corresponding blocks of these scans are added
before the scatter is computed. A rival is excluded if another rival fits better with p <= 0.005 and the
difference is at least 1 % of the squared error of the better rival. The model without the effect in question
is compared in the same way. If it is excluded and only one rival remains, this rival is the answer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import f_oneway

from litho_data.foundation import Array, InputError
from litho_data.foundation.results import Result
from litho_data.store import PrintedScan, Store, open_store
from litho_models.loop import run
from litho_models.loop.closing import Closed
from litho_models.loop.fits import Study
from litho_models.loop.judging import CONFIRM_P, SMALLEST_SHARE
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.loop.record import CloseLoop, Comparison, Decided, Decision, ScanFinding
from litho_models.loop.single_scans import coefficients
from litho_models.planning.answers import Z_DECIDED, surely_better, variance_ratio
from litho_models.planning.decided import with_decisions
from litho_models.planning.open_questions import open_questions
from litho_models.planning.questions import NONE, OpenQuestions, Question, fit_rivals, left_nm
from litho_models.scan_terms import freed_um, row_index, shrunk_line_offsets, terms_of_effect
from litho_models.scan_terms.lines import axis_along

UNSEEN: Decided = "not shown by these prints"
BOTH = PRINTER, MICROSCOPE = "the printer", "the microscope"
_BLOCK_PX = 32


def close_loop(
    store: str | Path,
    out: str | Path,
    *,
    new_prints: Sequence[str | Path] = (),
    **settings: Any,
) -> CloseLoop:
    """Close the loop on a store with ``loop.run.close_loop``, and write its open questions next to the
    result.

    Args:
        store: store on which the loop is closed.
        out: folder of the result.
        new_prints: further stores, which contain later prints of the same printer. These prints are used to
            decide the open questions (see ``decide``). The search for effects uses only the first store.
        settings: further arguments of ``loop.run.close_loop``.

    Raises:
        InputError: as in ``loop.run.close_loop``; also if a further store is of another printer, or if a scan
            has another orientation than its dataset card states.
    """
    first, *further = map(open_store, (store, *new_prints))
    new, dropped = list[PrintedScan](), list[str]()
    for one in further:
        scans, texts = new_scans(first, one)
        new += scans
        dropped += texts

    def asked(
        closed: Closed, single_scans: Sequence[ScanFinding]
    ) -> tuple[Closed, list[Decision], list[Result]]:
        open_ = open_questions(closed, first.dataset_id, single_scans)
        decisions = decide(closed, open_, new) if new else []
        return with_decisions(closed, open_, decisions), decisions, [open_]

    used = [one.sha256 for one in further]
    return run.close_loop(store, out, further=asked, decided_by=used, left_out=dropped, **settings)


def new_scans(first: Store, store: Store) -> tuple[list[PrintedScan], list[str]]:
    """Check that a further store is of the same printer as the first store, and that its scans have the
    orientation that its dataset card states. Return two lists: the scans with enough measured pixels, and one
    text for each scan that has too few, with its name and the reason why it is left out.

    Raises:
        InputError: the store is of another printer, its prints were planned for another dataset, none of its
            scans has enough measured pixels, or a scan has another orientation than the dataset card states.
    """
    for name in ("pitch_um", "level_height_um", "levels"):
        if getattr(store, name) != getattr(first, name):
            raise InputError(
                f"{name} of {store.path}",
                got=getattr(store, name),
                wanted=f"{getattr(first, name)}, as in {first.path}",
            )
    planned = store.manifest.get("card", {}).get("plan", {}).get("dataset_sha256", first.sha256)
    if planned != first.sha256:
        raise InputError(
            f"store {store.path}",
            got=f"prints planned for dataset {planned[:12]}…",
            wanted=f"prints planned for {first.path}, {first.sha256[:12]}…",
            hint="the first store must be the dataset for which these prints were planned",
        )
    scans, dropped = run.measured_scans(store)
    if not scans:
        raise InputError(
            f"scans of {store.path} to decide questions", got="none that can be used", wanted="at least 1"
        )
    for scan in scans:
        stated = round((scan.turned_deg or 0.0) / 90)
        # Only odd multiples of 90° are compared. Registration shows whether a print was rotated by 90°, but
        # the sign of a rotation is a matter of convention.
        if (stated - scan.quarter_turns) % 2:
            raise InputError(
                f"scan {scan.id} of {store.path}",
                got=f"rotated by {90 * scan.quarter_turns}° on its layout, but {90 * stated}° in its card",
                wanted="the same rotation in the card",
                hint="correct the column turned_deg of the card's table, and build the store again",
            )
    return scans, dropped


def decide(closed: Closed, open_: OpenQuestions, new: Sequence[PrintedScan]) -> list[Decision]:
    """Return the decisions on all open questions that scans can answer. Questions about missing facts are
    left out.

    Args:
        closed: the loop that left the questions.
        open_: the open questions of this loop.
        new: new scans, which this loop did not use.
    """
    judge = Judge(closed.final.twin.ungrouped(), closed.study, prepare_scans(new))
    kinds = {"lines": judge.of_lines, "per-scan": judge.of_single_scans}
    decisions = []
    for question in open_.questions:
        if question.kind != "fact":
            closed.study.report(f"deciding on {question.name}")
            decisions.append(kinds.get(question.kind, judge.among_rivals)(question))
    return decisions


@dataclass(frozen=True)
class Judge:
    """Decide open questions on new scans.

    Attributes:
        twin: the corrected model, with strengths that are the same in all scans.
        study: the scans to which this model was fitted.
        new: scans that were not used in these fits.
    """

    twin: Twin
    study: Study
    new: Sequence[PreparedScan]

    def among_rivals(self, question: Question) -> Decision:
        """Fit every rival (competing explanation) of the question to the old and new scans. Also fit a model
        without the effect in question. Then judge these fits on the new scans.
        """
        twins = {rival.name: rival.twin(self.twin) for rival in question.rivals}
        first = question.rivals[0]
        twins[NONE] = twins[first.name].without(first.effect)
        windows = [*self.study.windows, *(scan.window for scan in self.new)]
        left = {}
        for name, fit in fit_rivals(twins, windows).items():
            fitted = twins[name].at(fit.vector)
            left[name] = [left_nm(scan, fitted.height(scan)) for scan in self.new]
        return compared(question, self.new, left)

    def of_single_scans(self, question: Question) -> Decision:
        """Decide whether the printer or the microscope causes a per-scan term. For this purpose, compare the
        variance of the term between prints with its variance between the scans of one print.
        """
        own = terms_of_effect(question.name)
        maps = [self.twin.height(scan) for scan in self.new]
        found = coefficients(self.new, maps, own, own | {"offset", "gain", "bow"})
        prints = np.array([scan.print_id for scan in self.new])
        by_print = [found[prints == one] for one in np.unique(prints)]
        repeated = [one for one in by_print if len(one) > 1]
        count, total = len(repeated), sum(map(len, repeated))
        if count < 2:
            return _decision(question, self.new, BOTH, "no print was scanned twice", UNSEEN)
        ratio = float(np.median(f_oneway(*repeated).statistic))
        law, factor = variance_ratio(count, total)
        told = (
            "the ratio of the variance between prints to the variance between scans of one print is "
            f"F({count - 1}, {total - count}) = {ratio:.2f}"
        )
        left = _left(law.sf(ratio) <= CONFIRM_P, law.cdf(ratio / factor) <= CONFIRM_P)
        return _decision(question, self.new, left, told)

    def of_lines(self, question: Question) -> Decision:
        """Decide whether the printer or the microscope causes line offsets. For this purpose, compare two
        variances in the rotated scans: the variance of the offsets of the layout's rows, and the variance of
        the offsets of the scan lines.
        """
        turned = [scan for scan in self.new if axis_along(scan.line) == 0]
        if not turned:
            return _decision(question, self.new, BOTH, "no scan is rotated", UNSEEN)
        rows, lines = [], 0
        for scan in turned:
            used = scan.usable
            residual = freed_um(scan.height_um, self.twin.height(scan), used, frozenset({"offset"}))
            indices = row_index(used.shape), scan.line
            offsets = (shrunk_line_offsets(residual, used, one, _BLOCK_PX)[2] for one in indices)
            rows.append([*offsets, residual[used].var() / used.shape[1]])
            lines += len(used)
        written, scanned, own = 1e6 * np.mean(rows, axis=0)
        z = (written - scanned) / ((written + scanned + own) * np.sqrt(2 / lines))
        told = (
            f"in the rotated scans, the variance of line offsets is {written:.1f} nm² along the layout's "
            f"rows and {scanned:.1f} nm² along the scan lines (z = {z:.1f})"
        )
        return _decision(question, turned, _left(z >= Z_DECIDED, z <= -Z_DECIDED), told)


def compared(
    question: Question, new: Sequence[PreparedScan], left_nm: Mapping[str, Sequence[Array]]
) -> Decision:
    """Judge the answers to a question by their residuals on the new scans.

    Args:
        question: the question.
        new: the new scans.
        left_nm: for each answer, its residual on each new scan, as a list of maps of shape (ny, nx), nm. The
            lists are keyed by the name of the answer. One more list is for the model without the effect.
    """
    comparisons = [_compare(pair, left_nm, new, question) for pair in combinations(left_nm, 2)]
    # As in the loop, a difference that is smaller than the fraction ``SMALLEST_SHARE`` of the squared error
    # does not count, because it may come from effects that are not among the rivals.
    squares_nm2 = {name: np.mean([np.nanmean(one**2) for one in own]) for name, own in left_nm.items()}
    excluded = {
        one.worse
        for one in comparisons
        if one.z >= Z_DECIDED and one.gain_nm2 >= SMALLEST_SHARE * squares_nm2[one.better]
    }
    left = [name for name in left_nm if name not in {*excluded, NONE}]
    told = [
        f"{one.better} fits better than {one.worse} by {one.gain_nm2:.1f} nm² (z = {one.z:.1f})"
        for one in comparisons
        if one.better in left and one.worse != NONE
    ] or ["no rival fits better than another"]
    if len(left) > 1 and question.form_nm is not None:
        nearest_nm = min(one.difference_nm for one in comparisons if {one.better, one.worse} <= {*left})
        told.append(
            f"the model's own error is at most {question.form_nm:.1f} nm, and the two most similar "
            f"remaining rivals differ by {nearest_nm:.1f} nm"
        )
    nothing = not left or (NONE not in excluded and len(left) == 1)
    return _decision(question, new, left, "; ".join(told), NONE if nothing else None, comparisons)


def _compare(
    pair: tuple[str, str],
    left_nm: Mapping[str, Sequence[Array]],
    new: Sequence[PreparedScan],
    question: Question,
) -> Comparison:
    """Compare the squared errors of two rivals (competing explanations) on the new scans.

    The squared errors are summed over blocks of pixels. The difference between the sums of the two rivals is
    compared with its spread over the blocks of a print and with its spread between prints. If the scans of a
    print differ in size, their blocks do not correspond. The scans of each size are then treated separately.
    """
    by_print: dict[tuple[str, tuple[int, ...]], Array] = {}
    pixels, difference = 0, 0.0
    for scan, first, second in zip(new, *(left_nm[name] for name in pair), strict=True):
        pixels += int(np.isfinite(first).sum())
        difference += float(np.nansum((second - first) ** 2))
        key = scan.print_id, first.shape
        by_print[key] = by_print.get(key, 0.0) + _block_sums(second**2 - first**2)
    total = float(sum(sums.sum() for sums in by_print.values()))
    # The mean over the blocks of a print counts as the result of this print. The scatter of the blocks about
    # this mean counts as noise.
    noise = sum(sums.size * float(sums.var(ddof=1)) for sums in by_print.values())
    prints = len({name for name, _ in by_print})
    return Comparison(
        better=pair[total < 0],
        worse=pair[total >= 0],
        gain_nm2=abs(total) / max(pixels, 1),
        z=surely_better(question, abs(total), difference, noise, prints, pixels),
        difference_nm=float(np.sqrt(difference / max(pixels, 1))),
    )


def _block_sums(gain: Array) -> Array:
    sums = np.nan_to_num(gain)
    for axis, size in enumerate(gain.shape):
        count = max(2, size // _BLOCK_PX)
        sums = np.add.reduceat(sums, np.arange(count) * size // count, axis=axis)
    return sums


def _left(printer: bool, microscope: bool) -> Sequence[str]:
    """Return the sources (printer, microscope) that remain possible after a test. ``printer`` states whether
    the test points to the printer, and ``microscope`` states whether it points to the microscope. If the test
    points to neither or to both, both sources remain possible.
    """
    return BOTH if printer == microscope else [PRINTER if printer else MICROSCOPE]


def _decision(
    question: Question,
    scans: Sequence[PreparedScan],
    left: Sequence[str],
    evidence: str,
    verdict: Decided | None = None,
    comparisons: Sequence[Comparison] = (),
) -> Decision:
    """Make the record of the decision on a question.

    Args:
        question: the question.
        scans: the scans on which it was decided.
        left: the answers that remain possible.
        evidence: the evidence, in words.
        verdict: the verdict. If it is None, the question is decided if one answer remains, and otherwise
            still open.
        comparisons: the comparisons of the answers.
    """
    return Decision(
        question=question.name,
        kind=question.kind,
        declared=[rival.name for rival in question.rivals] or BOTH,
        left=left,
        verdict=verdict or ("decided" if len(left) == 1 else "still open"),
        evidence=evidence,
        prints=len({scan.print_id for scan in scans}),
        scans=len(scans),
        comparisons=comparisons,
    )
