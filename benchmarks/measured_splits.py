"""Tables of the measured run: the same models on other splits, and from other seeds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from statistics import mean, stdev
from typing import Any

from benchmarks.markdown_table import markdown_table, with_interval
from benchmarks.measured_models import PAPER_MODELS, floor_row, steps_text


def paper_table(draws: Sequence[dict[str, Any]], grouped: dict[str, Any]) -> str:
    """Errors on every draw of the paper's split, one row per model, and how far the models are apart."""
    heads = ("model", *(f"draw {own['split']['seed']}" for own in draws))
    heads += ("absolute error, mean over draws", "whole scans held out")
    rows: list[tuple[str, ...]] = []
    whole = {score["model"]: score["mae_datum_free_nm"] for score in grouped["scores"]}
    for name in [score["model"] for score in draws[0]["scores"]]:
        scores = [score for own in draws for score in own["scores"] if score["model"] == name]
        free = [with_interval(own["mae_datum_free_nm"], own["mae_datum_free_ci95_nm"]) for own in scores]
        absolute = sum(own["mae_abs_nm"] for own in scores) / len(scores)
        rows.append((name, *free, f"{absolute:.2f} nm", f"{whole[name]:.2f} nm"))
    for pairs in zip(*(own["paired"] for own in draws), strict=True):
        if not {pairs[0]["first"], pairs[0]["second"]} <= PAPER_MODELS:
            continue
        apart = [with_interval(pair["mean_nm"], pair["ci95_nm"]) for pair in pairs]
        rows.append((f"{pairs[0]['first']} − {pairs[0]['second']}", *apart, "–", "–"))
    split = draws[0]["split"]
    return markdown_table(
        heads,
        rows,
        f"Datum-free error (zero of each quadrant free). A draw holds out {len(split['scored_ids'])} of 96 "
        f"quadrants at random and trains on the others ({steps_text(draws[0])}); its number is the seed of "
        "split and training. Leaky, as the paper's split is; the last column has the split by scan beside "
        f"it. {_order_of_draws(draws)} Quadrants of the "
        f"{len(split['lock_box'])} locked scans take part, in training and in the errors.",
    )


def extrapolation_table(by_print: dict[str, Any], by_scan: dict[str, Any], noise: dict[str, Any]) -> str:
    """Errors where every scan of a print is held out, beside those where other scans of it are seen."""
    seen = {score["model"]: score for score in by_scan["scores"]}
    rows: list[tuple[str, ...]] = []
    for score in by_print["scores"]:
        other = seen[score["model"]]
        rows.append(
            (
                score["model"],
                with_interval(score["mae_datum_free_nm"], score["mae_datum_free_ci95_nm"]),
                f"{other['mae_datum_free_nm']:.2f} nm",
                with_interval(score["mae_abs_nm"], score["mae_abs_ci95_nm"]),
                f"{other['mae_abs_nm']:.2f} nm",
            )
        )
    heads: tuple[str, ...] = ("model", "datum-free error, whole prints held out", "whole scans held out")
    heads += ("absolute error, whole prints held out", "whole scans held out")
    rows.append(floor_row(noise["noise_floor"], "offset", "offset", "none", "none"))
    split = by_print["split"]
    missing = [name for name in seen if name not in {score["model"] for score in by_print["scores"]}]
    left_out = f" Not run: {', '.join(missing)}." if missing else ""
    return markdown_table(
        heads,
        rows,
        f"{split['folds']} folds, one per print, {len(split['scored_ids'])} scans; "
        f"the {len(split['lock_box'])} locked scans are in no fold.{left_out}",
    )


def seeds_table(whole: dict[str, Any], others: Sequence[dict[str, Any]]) -> str:
    """Errors of networks from several seeds of weights and crops, on the folds that all have in common.

    Args:
        whole: the benchmark of the first seed, all folds.
        others: benchmarks of the same models from other seeds, some of the folds.
    """
    split, names = others[0]["split"], [score["model"] for score in others[0]["scores"]]
    runs = (whole, *others)
    errors = {name: [_mean_error(run, name, split["scored_ids"]) for run in runs] for name in names}
    seeds = [run["training"][names[0]]["seed"] for run in runs]
    return markdown_table(
        ("model", *(f"seed {seed}" for seed in seeds), "σ over seeds"),
        [
            (name, *(f"{value:.2f} nm" for value in values), f"{stdev(values):.2f} nm")
            for name, values in errors.items()
        ],
        f"Mean absolute error, zero of each scan free (k = 1), on the {len(split['scored_ids'])} scans held "
        f"out by the first {split['first_folds']} of {split['folds']} folds, with the shared background; "
        f"{steps_text(others[0])}. A seed draws the first weights and the crops.",
    )


def _mean_error(benchmark: dict[str, Any], model: str, scans: Sequence[str]) -> float:
    """Mean datum-free error of some scans, nm; all of them must have been scored."""
    score = next(score for score in benchmark["scores"] if score["model"] == model)
    errors = {row["scan"]: row["mae_datum_free_nm"] for row in score["scans"]}
    return mean(errors[scan] for scan in scans)


def _order_of_draws(draws: Sequence[dict[str, Any]]) -> str:
    """Which model is ahead of which, and in how many draws."""
    orders = Counter(
        ", ".join(
            score["model"]
            for score in sorted(own["scores"], key=lambda score: score["mae_datum_free_nm"])
            if score["model"] in PAPER_MODELS
        )
        for own in draws
    )
    counted = "; ".join(f"{order} in {count} of {len(draws)} draws" for order, count in orders.most_common())
    return f"From best to worst: {counted}."
