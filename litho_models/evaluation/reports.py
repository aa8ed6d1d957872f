"""``report.html`` of an evaluation and of a benchmark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from litho_data.reports.page import Page
from litho_data.store import PrintedScan
from litho_models.evaluation import plots, tables
from litho_models.evaluation.results import Benchmark, Evaluation
from litho_models.evaluation.tables import benchmark_verdict, evaluation_verdict
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.noise_floor import NoiseFloor
from litho_models.scoring.records import ModelScores
from litho_models.splits.folds import ScoredSplit

_WORDS = Path(__file__).with_name("words.toml")
_OF_PREDICTION = ("tiles_max_nm", "tiles_rms_nm", "cost_seconds_per_scan", "cost_peak_memory_mib")
_OF_FIT = ("diagnostics_training_nm", "diagnostics_inner_validation_nm", "diagnostics_held_out_nm")
_PAPER_DATASET = "neural-lithography"
_SPLIT_TEXT = {
    "grouped": "whole scans are held out; scans of the lock box are in no fold",
    "leave-one-print-out": "all scans of one print are held out at a time; the lock box is in no fold",
    "paper": "a random quarter of the quadrants is held out: quadrants of one scan lie on both sides, so "
    "this split leaks and serves comparison with the paper only",
}


def write_evaluation_report(
    result: Evaluation, scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray], out: str | Path
) -> Path:
    """Render the result into ``out``; returns the page."""
    scores = result.scores
    title = f"{result.model.name} on {result.dataset.name}"
    page = Page(title, run=result.run, facts=_facts(result), words=_WORDS)
    page.verdict(evaluation_verdict(result))
    if result.trained_on_scored_scans:
        count = len(result.trained_on_scored_scans)
        page.note(f"{count} of the scored scans were used in training: this is not a held-out error.")
    if result.model.extrapolated:
        page.note("Layouts beyond the calibrated range were accepted (extrapolate).")
    page.figure(
        plots.error_bars([scores], result.noise_floor.mae_at(result.nuisance.policy), False),
        "Error and noise floor.",
    )
    page.paragraph(lock_box_text(result.split))
    worst = max(range(len(scans)), key=list(scores.leading_of_scans_nm.values()).__getitem__)
    shown = {scores.model: predictions_um[worst]}
    page.heading("The worst scan")
    page.figure(plots.residual_maps(scans[worst], shown, result.nuisance), "Measured height and error.")
    page.figure(plots.line_profiles(scans[worst], shown, result.nuisance), "Middle row.")
    page.heading("The errors in numbers", folded=True)
    _headline(page, [scores], result, "Error over scans.", "headline.csv")
    _policies(page, [scores], result.nuisance, result.noise_floor)
    _metrics(page, [scores], "Phase, similarity, edges.")
    page.table(
        [result.model],
        "The same pixels in another crop; what predicting a scan costs on the machine that made this.",
        "model.csv",
        columns=("name", "parameters", *_OF_PREDICTION),
    )
    _by_level_and_frequency(page, [scores])
    _all_numbers(page, [scores], "By scan.", "By level.")
    return page.write(out)


def write_benchmark_report(
    result: Benchmark,
    scans: Sequence[PrintedScan],
    predictions_um: Mapping[str, Mapping[str, np.ndarray]],
    out: str | Path,
) -> Path:
    """Render the result into ``out``; ``predictions_um`` is model name -> scan id -> height."""
    scores = sorted(result.scores, key=lambda s: -s.leading_nm)
    best = scores[-1]
    on_paper_data = result.dataset.name == _PAPER_DATASET
    page = Page(f"Benchmark on {result.dataset.name}", run=result.run, facts=_facts(result), words=_WORDS)
    page.verdict(benchmark_verdict(result))
    if result.split.first_folds is not None:
        page.note(f"Only {result.split.first_folds} of {result.split.folds} folds were fitted and scored.")
    if len(best.scans) < 8:
        page.note(f"Only {len(best.scans)} scans: intervals over scans are rough.")
    page.figure(
        plots.error_bars(scores, result.noise_floor.mae_at(result.nuisance.policy), on_paper_data),
        f"Held-out error of every model. Split '{result.split.kind}': {_SPLIT_TEXT[result.split.kind]}.",
    )
    _headline(page, scores, result, "Held-out error.", "benchmark.csv")
    if on_paper_data:
        page.note(paper_sentence(result.split.kind))
    page.heading("Which differences are more than chance?", folded=True)
    page.table(
        result.paired,
        "Error of one model minus that of another over the same scans, with the same terms fitted.",
        "pairs.csv",
        digits=3,
    )
    if result.locked_scores:
        page.heading("Lock box", folded=True)
        _headline(
            page,
            result.locked_scores,
            result,
            "Trained on all development scans, scored once on the locked scans.",
            "lock_box.csv",
        )
    page.heading("One scan", folded=True)
    middle = _median_scan(best)
    shown = {s.model: predictions_um[s.model][scans[middle].id] for s in scores}
    page.figure(
        plots.residual_maps(scans[middle], shown, result.nuisance),
        f"{scans[middle].id}, the scan of median error: measured height and held-out errors.",
    )
    profiles = {name: shown[name] for name in [s.model for s in scores[-2:]]}
    page.figure(plots.line_profiles(scans[middle], profiles, result.nuisance), "Its middle row.")
    page.heading("Phase, similarity, edges", folded=True)
    _metrics(page, scores, "Means over held-out scans.")
    page.heading("With other terms fitted", folded=True)
    _policies(page, scores, result.nuisance, result.noise_floor)
    page.heading("Gain and offset of single prints", folded=True)
    page.figure(
        plots.print_gains(best),
        f"Line through measured against predicted height ({best.model}, nothing fitted to the scan before); "
        "95 % ellipses from blocks of 32 px. Numbers in scans.csv.",
    )
    _by_level_and_frequency(page, scores)
    page.heading("Training", folded=True)
    page.table(
        result.fits,
        "Every fit: error on its training, inner-validation and held-out scans, all without a background and "
        "with the zero height of each scan fitted, so that over-fitting shows; the largest and the RMS "
        "difference of the same pixels in another crop; what training and predicting cost here.",
        "fits.csv",
        digits=3,
        columns=(
            "model",
            "fold",
            *_OF_FIT,
            "parameters",
            "seconds",
            *(f"diagnostics_{c}" for c in _OF_PREDICTION),
        ),
    )
    curves = [fit for fit in result.fits if len(fit.steps) > 1]
    if curves:
        page.figure(plots.loss_curves(curves), "Error during training.")
    _all_numbers(page, scores, "By model and scan.", "By model and level.")
    return page.write(out)


def _facts(result: Evaluation | Benchmark) -> dict[str, object]:
    facts: dict[str, object] = {
        "dataset": result.dataset.sha256,
        "seeds": ", ".join(map(str, result.run.seeds)),
    }
    return facts | ({"model": result.model.sha256} if isinstance(result, Evaluation) else {})


def _headline(
    page: Page, scores: Sequence[ModelScores], result: Evaluation | Benchmark, caption: str, csv_name: str
) -> None:
    page.table(tables.headline_table(scores, result.nuisance, result.noise_floor), caption, csv_name)


def _metrics(page: Page, scores: Sequence[ModelScores], caption: str) -> None:
    page.table(tables.metric_table(scores), caption, "metrics.csv", digits=3)
    page.paragraph(tables.metric_text())


def lock_box_text(split: ScoredSplit) -> str:
    """What was done with the locked scans of the dataset."""
    if not split.lock_box:
        return "The dataset is too small for locked scans."
    scored = [scan_id for scan_id in split.lock_box if scan_id in split.scored_ids]
    if not scored:
        return f"Locked scans of the dataset, left out: {len(split.lock_box)}."
    return f"Locked scans of the dataset are among the scored ones: {', '.join(scored)}."


def paper_sentence(split: str) -> str:
    """Why an error here is or is not comparable with the paper's."""
    shared = (
        f"The paper reports {plots.PAPER_MAE_NM} nm for PBL on 24 of 96 random quadrants, on 8-bit heights "
        "shifted to a minimum of zero, for the checkpoint chosen on those same quadrants. "
    )
    if split == "paper":
        return shared + (
            "This split is of the same kind, but heights are floating point and the checkpoint is not chosen "
            "on the scored quadrants: the error with nothing fitted is close to comparable, and leaks."
        )
    return shared + (
        "Here whole scans are held out and nothing is chosen on them. The error with nothing fitted carries "
        "the unknown zero of each new scan, the other does not; neither can be compared with the paper's."
    )


def _policies(
    page: Page, scores: Sequence[ModelScores], protocol: NuisanceProtocol, floor: NoiseFloor
) -> None:
    page.table(
        tables.policy_table(scores, protocol, floor),
        "Mean absolute error by what is fitted to each scan, with and without the background, nm.",
        "policies.csv",
    )
    page.paragraph(tables.protocol_text(protocol))
    page.paragraph(tables.floor_text(floor))


def _by_level_and_frequency(page: Page, scores: Sequence[ModelScores]) -> None:
    page.heading("By level and frequency", folded=True)
    page.figure(plots.level_bias(scores), "Error by printed level.")
    page.figure(plots.transfer(scores), "Transfer, coherence and error by spatial frequency.")
    page.table(
        tables.band_table(scores),
        "How far up in frequency the prediction follows the measurement, cycles/µm.",
        "bands.csv",
    )


def _all_numbers(page: Page, scores: Sequence[ModelScores], by_scan: str, by_level: str) -> None:
    page.heading("By scan and by level", folded=True)
    page.table(tables.scan_table(scores), by_scan, "scans.csv")
    page.table(tables.level_table(scores), by_level, "levels.csv")
    page.heading("Notes on these numbers", folded=True)
    for note in tables.caveats(scores):
        page.paragraph(note)


def _median_scan(score: ModelScores) -> int:
    errors = np.array(list(score.leading_of_scans_nm.values()))
    return int(np.argsort(errors)[len(errors) // 2])
