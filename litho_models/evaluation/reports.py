"""Write ``report.html`` of an evaluation or a benchmark."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from litho_data.reports.page import Page
from litho_data.store import PrintedScan
from litho_models.evaluation import plots, tables
from litho_models.evaluation.results import Benchmark, Evaluation
from litho_models.evaluation.wording import benchmark_verdict, evaluation_verdict, said
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.metrics import residual_um
from litho_models.scoring.records import ModelScores
from litho_models.splits.folds import ScoredSplit

_WORDS = Path(__file__).with_name("words.toml")
_OF_FIT = (
    *("model", "fold", "diagnostics_training_nm", "diagnostics_inner_validation_nm"),
    *("diagnostics_held_out_nm", "parameters", "seconds"),
)
_PAPER_DATASET = "neural-lithography"
_SPLIT_TEXT = {
    "grouped": "whole scans are held out; scans of the lock box are in no fold",
    "leave-one-print-out": "all scans of one print are held out together; scans of the lock box are in no "
    "fold",
    "paper": "a random quarter of the quadrants is held out. The training set and the test set both contain "
    "quadrants of the same scans, so errors are too small: use this split only for comparison with the paper",
}


def write_evaluation_report(
    result: Evaluation, scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray], out: str | Path
) -> Path:
    """Write the report of an evaluation into the folder ``out``, and return the path of the report."""
    scores = result.scores
    page = _page(f"{result.model.name} on {result.dataset.name}", result, {"model": result.model.sha256})
    page.verdict(evaluation_verdict(result))
    if count := len(result.trained_on_scored_scans):
        page.note(f"The model was trained on {count} of the scored scans, so this is not a held-out error.")
    if result.model.extrapolated:
        page.note("Layouts with heights beyond the calibrated range were accepted (option extrapolate).")
    _errors(page, result, [scores], "Mean error over scans.", "headline.csv")
    page.paragraph(lock_box_text(result.split))
    worst = int(np.argmax(list(scores.leading_of_scans_nm.values())))
    _one_scan(page, "The worst scan", scans[worst], {scores.model: predictions_um[worst]}, result.nuisance)
    _numbers(page, result, [scores])
    return page.write(out)


def write_benchmark_report(
    result: Benchmark,
    scans: Sequence[PrintedScan],
    predictions_um: Mapping[str, Sequence[np.ndarray]],
    out: str | Path,
) -> Path:
    """Write the report of a benchmark into the folder ``out``, and return the path of the report.
    ``predictions_um`` contains, for each model, the height map that it predicts for each scan.
    """
    scores, split = sorted(result.scores, key=lambda s: -s.leading_nm), result.split
    best = scores[-1]
    page = _page(f"Benchmark on {result.dataset.name}", result, {})
    page.verdict(benchmark_verdict(result))
    if split.first_folds is not None:
        page.note(f"Only {split.first_folds} of {split.folds} folds were fitted and scored.")
    if len(best.scans) < 8:
        page.note(f"Only {len(best.scans)} scans were scored, so confidence intervals are rough.")
    caption = f"Held-out error of every model. Split '{split.kind}': {_SPLIT_TEXT[split.kind]}."
    _errors(page, result, scores, caption, "benchmark.csv")
    if result.dataset.name == _PAPER_DATASET:
        page.note(*said("paper", split=split.kind, paper_nm=plots.PAPER_MAE_NM))
    page.heading("Which differences exceed chance?", folded=True)
    page.table(
        result.paired,
        "Error of one model minus the error of another model, for the same scans and with the same terms "
        "fitted.",
        "pairs.csv",
        digits=3,
    )
    if result.locked_scores:
        page.heading("Lock box", folded=True)
        page.table(
            tables.headline_table(result.locked_scores, result.nuisance, result.noise_floor),
            "The models were trained on all development scans and scored once on the locked scans.",
            "lock_box.csv",
        )
    middle = int(np.argsort(list(best.leading_of_scans_nm.values()))[len(scans) // 2])
    shown = {s.model: predictions_um[s.model][middle] for s in scores}
    _one_scan(page, "The scan with the median error", scans[middle], shown, result.nuisance)
    page.heading("Training", folded=True)
    page.table(
        result.fits,
        "Training time of every fit, and errors of the fitted model on training, inner-validation and "
        "held-out scans. Differences between these errors show over-fitting. No background is used, and the "
        "zero height of each scan is fitted.",
        "fits.csv",
        digits=3,
        columns=_OF_FIT,
    )
    _numbers(page, result, scores)
    return page.write(out)


def _page(title: str, result: Evaluation | Benchmark, facts: Mapping[str, object]) -> Page:
    known = {"dataset": result.dataset.sha256, "seeds": ", ".join(map(str, result.run.seeds)), **facts}
    return Page(title, run=result.run, facts=known, words=_WORDS)


def _errors(
    page: Page, result: Evaluation | Benchmark, scores: Sequence[ModelScores], caption: str, csv_name: str
) -> None:
    floor = result.noise_floor
    held_out_on_paper_data = isinstance(result, Benchmark) and result.dataset.name == _PAPER_DATASET
    page.figure(
        plots.error_bars(scores, floor.mae_at(result.nuisance.policy), held_out_on_paper_data), caption
    )
    page.table(
        tables.headline_table(scores, result.nuisance, floor), "The values shown in this plot.", csv_name
    )


def _one_scan(
    page: Page,
    title: str,
    scan: PrintedScan,
    predictions_um: Mapping[str, np.ndarray],
    protocol: NuisanceProtocol,
) -> None:
    residuals = {name: residual_um(scan, own, protocol) for name, own in predictions_um.items()}
    page.heading(title, folded=True)
    page.figure(plots.residual_maps(scan, residuals), f"{scan.id}: measured height, and error of each model.")
    last = dict(list(residuals.items())[-2:])
    page.figure(plots.line_profiles(scan, last), "The middle row of this scan.")


def _numbers(page: Page, result: Evaluation | Benchmark, scores: Sequence[ModelScores]) -> None:
    page.heading("Phase, similarity, edges", folded=True)
    page.table(tables.metric_table(scores), "Means over scans.", "metrics.csv", digits=3)
    page.paragraph(tables.metric_text(scores))
    page.heading("With other terms fitted", folded=True)
    page.table(
        tables.policy_table(scores, result.nuisance, result.noise_floor),
        "Mean absolute error in nm, for each set of terms that may be fitted to a scan, with and without the "
        "background.",
        "policies.csv",
    )
    for sentence in said("protocol", protocol=result.nuisance, floor=result.noise_floor):
        page.paragraph(sentence)
    page.heading("By level and frequency", folded=True)
    page.figure(plots.level_bias(scores), "Error by printed level.")
    page.figure(plots.transfer(scores), "Transfer function, coherence and error by spatial frequency.")
    page.heading("By scan and by level", folded=True)
    page.table(tables.scan_table(scores), "By scan.", "scans.csv")
    page.table(tables.level_table(scores), "By level.", "levels.csv")
    if notes := said("notes", scores=scores):
        page.heading("Notes on these numbers", folded=True)
        page.points(notes)


def lock_box_text(split: ScoredSplit) -> str:
    """Return a sentence that says whether the locked scans of the dataset were scored."""
    if not split.lock_box:
        return "The dataset is too small to lock any scans."
    scored = [scan_id for scan_id in split.lock_box if scan_id in split.scored_ids]
    if not scored:
        return f"{len(split.lock_box)} locked scans, which are set aside for a final test, are not scored."
    return f"Locked scans, which are set aside for a final test, are scored too: {', '.join(scored)}."
