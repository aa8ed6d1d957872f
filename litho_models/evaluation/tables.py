"""What the reports of an evaluation and a benchmark say: tables, notes, verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from litho_models.evaluation.results import Benchmark, Evaluation
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.metric_registry import metrics_text, registered_metrics
from litho_models.scoring.metrics import INDEX_STEP, WAVELENGTH_UM
from litho_models.scoring.noise_floor import NoiseFloor
from litho_models.scoring.records import Interval, ModelScores, Paired

if TYPE_CHECKING:
    import pandas as pd


# One mapping a row, column to value.
Rows = list[dict[str, Any]]


def headline_table(
    scores: Sequence[ModelScores], protocol: NuisanceProtocol, floor: NoiseFloor
) -> pd.DataFrame:
    """One row per model: both errors with intervals, what they have above the noise floor, spread and bias.

    Below them the floor itself, under each column that of its own scan terms. Of films the errors of edges
    and features.
    """
    import pandas as pd

    if scores[0].seen_by == "sem":
        return pd.DataFrame([_film_row(score) for score in scores])
    below = floor.at(protocol.policy)
    least = floor.mae_at(protocol.policy)
    rows = [
        {
            "model": s.model,
            "mae_datum_free_nm": s.mae_datum_free_nm,
            "mae_datum_free_ci95_nm": interval_text(s.mae_datum_free_ci95_nm),
            "above_floor_nm": None if least is None else s.mae_datum_free_nm - least,
            "rmse_datum_free_nm": s.rmse_datum_free_nm,
            "mae_abs_nm": s.mae_abs_nm,
            "mae_abs_ci95_nm": interval_text(s.mae_abs_ci95_nm),
            "bias_nm": s.bias_nm,
            "scans": len(s.scans),
        }
        for s in scores
    ]
    known = {
        "model": f"noise floor ({floor.kind.replace('-', ' ')})",
        "mae_datum_free_nm": least,
        "mae_datum_free_ci95_nm": interval_text(below.mae_ci95_nm if below else None),
        "rmse_datum_free_nm": below.rmse_nm if below else floor.rmse_nm if least is not None else None,
        "mae_abs_nm": floor.mae_at("none"),
        "scans": "",
    }
    return pd.DataFrame([*rows, known])


def _film_row(score: ModelScores) -> dict[str, Any]:
    return {
        "model": score.model,
        "edge_mean_nm": score.edge_mean_nm,
        "edge_mean_ci95_nm": interval_text(score.edge_mean_ci95_nm),
        "edge_p95_nm": score.edge_p95_nm,
        **score.metrics,
        "edge_unmatched": score.edge_unmatched,
        "edge_unmatched_expected": score.edge_unmatched_expected,
        "mae_abs_nm": score.mae_abs_nm,
        "scans": len(score.scans),
    }


def policy_table(scores: Sequence[ModelScores], protocol: NuisanceProtocol, floor: NoiseFloor) -> Rows:
    """One row per model and background, one column per policy; for line offsets the effective number.

    The last row is the noise floor under each.
    """
    rows = []
    for s in scores:
        for background, errors in ((protocol.background, s.by_policy), ("none", s.without_background)):
            if errors:
                named = {f"{error.policy}_mae_nm": error.mae_nm for error in errors}
                lines = {f"{error.policy}_k": error.k for error in errors if error.policy == "full+rows"}
                rows.append({"model": s.model, "background": background, **named, **lines})
    if floor.by_policy:
        below = {f"{row.policy}_mae_nm": row.mae_nm for row in floor.by_policy}
        rows.append(
            {
                "model": f"noise floor ({floor.kind.replace('-', ' ')})",
                "background": protocol.background,
                **below,
            }
        )
    return rows


def metric_table(scores: Sequence[ModelScores]) -> Rows:
    """One row per model: phase error, and all metrics of ``metric_registry``."""
    keys = [m.key for m in registered_metrics() if any(s.metric(m.key) is not None for s in scores)]
    return [
        {
            "model": s.model,
            "phase_rms_waves": s.phase_rms_waves,
            **{key: s.metric(key) for key in keys},
        }
        for s in scores
    ]


def band_table(scores: Sequence[ModelScores]) -> Rows:
    """One row per model: how far up in frequency the prediction follows the measurement, along x and y."""
    names = [f"{figure}_{axis}_per_um" for figure in ("half_power", "noise_band") for axis in "xy"]
    return [{"model": s.model, **{name: getattr(s.transfer, name) for name in names}} for s in scores]


def scan_table(scores: Sequence[ModelScores]) -> Rows:
    """One row per model and scan."""
    return [
        {
            "model": s.model,
            "scan": row.scan,
            "print": row.print,
            **row.model_dump(exclude={"metrics", "scan", "print"}),
            **row.metrics,
        }
        for s in scores
        for row in s.scans
    ]


def level_table(scores: Sequence[ModelScores]) -> Rows:
    """One row per model and printed level."""
    return [{"model": s.model, **entry.model_dump()} for s in scores for entry in s.by_level]


def interval_text(interval: Interval) -> str:
    """An interval for people."""
    return "–" if interval is None else f"{interval[0]:.2f} … {interval[1]:.2f}"


def protocol_text(protocol: NuisanceProtocol) -> str:
    """How the datum-free error was obtained, in one paragraph."""
    lines = " and its line offsets" if protocol.policy == "full+rows" else ""
    return (
        "For the error with nothing fitted, predictions stay as they are. For the other, each scan is first "
        f"freed of the terms of policy "
        f"'{protocol.policy}' (k = {protocol.k:g} per scan{lines}), fitted on one half of a checkerboard of "
        f"{protocol.block_px} px blocks shrunk by {protocol.buffer_px} px and scored on the other half, "
        "then the other way round; line offsets come from the other side of the scan. Means are per scan "
        "first, then over scans; intervals resample whole scans (2,000 draws). "
        f"{_BACKGROUND_TEXT[protocol.background]}"
    )


_BACKGROUND_TEXT = {
    "shared": "Background 'shared': predictions go through the measurement model (levelling, background, "
    "displacements, gain; shared by all training scans or a group of them), learned on the training scans "
    "with the printer; nothing of it is fitted to the scored scan. The table of policies has the errors "
    "of the print alone too.",
    "none": "Background 'none': predictions are those of the print alone.",
    "training": "Background 'training': to each prediction is added what the training scans have in common "
    "beside their prints (five smooth terms, nothing fitted to the scored scan); the table of policies has "
    "the errors without it too. It makes no difference to policies with smooth terms of their own.",
}


def floor_text(floor: NoiseFloor) -> str:
    """The noise floor and how it is known."""
    known = f"MAE {floor.mae_nm:.2f} nm, RMSE {floor.rmse_nm:.2f} nm; " if floor.mae_nm is not None else ""
    upper = "; at least what a model has above it can still be won" if floor.kind == "upper-estimate" else ""
    return f"Noise floor ({floor.kind}): {known}{floor.source}{upper}."


def metric_text() -> str:
    """What the columns of ``metric_table`` are."""
    return (
        f"The phase error is the RMS error seen by light of {WAVELENGTH_UM:g} µm that passes the print "
        f"(index step {INDEX_STEP:g}). {metrics_text()}"
    )


def caveats(scores: Sequence[ModelScores]) -> list[str]:
    """Caveats: what was dropped, what is degenerate, what is few."""
    notes = []
    for s in scores:
        if s.constant_predictions:
            notes.append(f"{s.model} predicts a constant height for {s.constant_predictions} scans.")
        if s.dropped_pixels:
            notes.append(
                f"{s.model}: {s.dropped_pixels} pixels were not measured or not valid and are not scored."
            )
    if scores and scores[0].seen_by == "afm":
        s = min(scores, key=lambda entry: entry.leading_nm)
        notes.append(
            f"Line offsets left by {s.model}: {s.row_offset_sd_nm:.1f} nm along the rows of the layout, "
            f"{s.scan_line_offset_sd_nm:.1f} nm along the scan's own lines. Offsets that follow the layout "
            "although the scans are rotated come from the print, not from the microscope."
        )
    return notes


# What counts as more than chance: an interval without zero, and sign flips of the independent units below.
_CHANCE = 0.05
_OF = {"afm": "", "sem": " of the edges"}


def benchmark_verdict(result: Benchmark) -> str:
    """Which model predicts best, by how much, whether that is more than chance, and what noise leaves."""
    ranking = sorted(result.scores, key=lambda one: one.leading_nm)
    best, *others = ranking
    unit = "quadrants" if result.split.kind == "paper" else "scans"
    text = (
        f"{best.model} is best at predicting {unit} it was not trained on: {best.leading_nm:.2f} nm "
        f"mean error{_OF[best.seen_by]} over {len(best.scans)} {unit}. "
    )
    if others:
        second = others[0]
        text += f"{second.model} is next with {second.leading_nm:.2f} nm; "
        names = {best.model, second.model}
        pair = next((one for one in result.paired if {one.first, one.second} == names), None)
        text += "they were not compared scan by scan. " if pair is None else f"{chance_text(pair)}. "
    if best.seen_by == "sem":
        return text.rstrip()
    return text + _share_of_noise(result.noise_floor, best.mae_datum_free_nm, result.nuisance.policy)


def evaluation_verdict(result: Evaluation) -> str:
    """How far the model is off on scans, what of it the zero height is, and what noise leaves."""
    scores = result.scores
    trained = len(result.trained_on_scored_scans)
    seen = f" ({trained} of which it was trained on)" if trained else ""
    if scores.seen_by == "sem":
        of_edges = f"its edges lie {scores.leading_nm:.2f} nm from the measured ones"
        return f"{result.model.name}: {of_edges}, mean over {len(scores.scans)} scans{seen}."
    return (
        f"{result.model.name} is off by {scores.mae_abs_nm:.1f} nm over {len(scores.scans)} scans{seen} as "
        f"it stands, and by {scores.mae_datum_free_nm:.2f} nm once the scan's own terms are fitted. "
        + _share_of_noise(result.noise_floor, scores.mae_datum_free_nm, result.nuisance.policy)
    )


def chance_text(pair: Paired) -> str:
    """Whether the difference of a pair is more than chance, judged over prints where there are several."""
    size = f"the difference is {abs(pair.mean_nm):.2f} nm"
    over = pair.over_prints
    if over is not None and over.smallest_p > _CHANCE:
        return f"{size}, and {over.count} prints are too few to tell it from chance"
    p, count, unit = (pair.p, pair.scans, "scans") if over is None else (over.p, over.count, "prints")
    excluded = pair.ci95_nm is not None and (pair.ci95_nm[0] > 0 or pair.ci95_nm[1] < 0)
    if p <= _CHANCE and excluded:
        return f"{size}, more than chance (p = {p:.2g} over {count} {unit})"
    return f"{size}, which may be chance (p = {p:.2g} over {count} {unit})"


def _share_of_noise(floor: NoiseFloor, error_nm: float, policy: str) -> str:
    """What of an error is noise that no model can predict."""
    least = floor.mae_at(policy)
    if least is None:
        return "How much of it is noise that no model can predict is not known."
    if floor.kind == "upper-estimate":
        return f"Noise that no model can predict makes up {least:.2f} nm at most."
    return (
        f"Noise that no model can predict makes up {least:.2f} nm, so {error_nm - least:.2f} nm can be won."
    )
