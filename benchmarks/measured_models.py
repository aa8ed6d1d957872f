"""Tables of the measured run: models on held-out scans, the noise beside them, designs through them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from benchmarks.markdown_table import markdown_table, with_interval

PAPER_MODELS = {"physics", "pbl", "fno"}


def benchmark_table(benchmark: dict[str, Any], noise: dict[str, Any]) -> str:
    """Held-out errors of every model, one row each, above what is known of the noise floor."""
    heads = (
        "model",
        "datum-free error (zero of each scan free, k = 1)",
        "the same without the shared background",
        "with tilt, bow and gain free, k = 7",
        "absolute error",
        "parameters",
    )
    rows = []
    parameters = {fit["model"]: fit["parameters"] for fit in benchmark["fits"]}
    for score in benchmark["scores"]:
        policies = {entry["policy"]: entry["mae_nm"] for entry in score["by_policy"]}
        bare = {entry["policy"]: entry["mae_nm"] for entry in score["without_background"]}
        free = with_interval(score["mae_datum_free_nm"], score["mae_datum_free_ci95_nm"])
        absolute = with_interval(score["mae_abs_nm"], score["mae_abs_ci95_nm"])
        without, relaxed = f"{bare['offset']:.2f} nm", f"{policies['full']:.2f} nm"
        rows.append((score["model"], free, without, relaxed, absolute, f"{parameters[score['model']]:,}"))
    rows += [_floor_row(own["noise_floor"], len(heads)) for own in (benchmark, noise)]
    split = benchmark["split"]
    return markdown_table(
        heads,
        rows,
        f"Mean absolute error on held-out scans ({len(split['scored_ids'])} scans, {split['folds']} folds "
        f"by scan, seed {split['seed']}; {len(split['lock_box'])} locked scans are in no fold and in no "
        f"figure of this table; {_steps(benchmark)}), with 95 % bootstrap intervals over scans. Per-scan "
        "terms are fitted on pixels that are not scored. The shared background is what levelling leaves in "
        "every map: five numbers from the training scans, added to predictions of measured maps and to no "
        "design. Noise floor: from the roughness of the paper's flat print, whose band and levelling are not "
        "those of these scans, and what these scans alone show; the true one lies above the lower bound.",
    )


def headline_table(benchmark: dict[str, Any], noise: dict[str, Any]) -> str:
    """The errors of a few models, the bounds on the noise and the paper's figure, for the project's page."""
    parameters = {fit["model"]: fit["parameters"] for fit in benchmark["fits"]}
    scores = {score["model"]: score for score in benchmark["scores"]}
    rows = []
    for name in ("affine", "physics", "linear", "pbl", "fno"):
        score = scores[name]
        full = next(entry["mae_nm"] for entry in score["by_policy"] if entry["policy"] == "full")
        free = with_interval(score["mae_datum_free_nm"], score["mae_datum_free_ci95_nm"])
        rows.append((name, f"{parameters[name]:,}", free, f"{full:.2f} nm"))
    low, high = noise["noise_floor"]["mae_nm"], benchmark["noise_floor"]["mae_nm"]
    rows.append(("noise, a lower bound from these scans", "–", f"{low:.2f} nm", "–"))
    rows.append(("noise, from the roughness of the paper's flat print", "–", f"{high:.2f} nm", "–"))
    rows.append(("PBL in the paper: other split, levelling and zero", "–", "24.35 nm, not comparable", "–"))
    split = benchmark["split"]
    return markdown_table(
        ("model", "parameters", "zero height free (k = 1)", "offset, gain, tilt and bow free (k = 7)"),
        rows,
        f"Mean absolute error over all valid pixels of {len(split['scored_ids'])} scans in {split['folds']} "
        "folds: each scan is predicted by models that were not trained on it, with the smooth background "
        "that their training scans share. k counts the terms fitted to each scan, on pixels other than those "
        "scored. Intervals: 95 %, bootstrap over scans, which are not independent: they come from 6 prints. "
        "Over 6 prints a sign-flip test cannot go below p = 0.031. "
        "No model can predict the noise; the first bound is too low, the second is of another band and "
        "levelling.",
    )


def paired_table(benchmark: dict[str, Any]) -> str:
    """How much better each model is than each other, scan by scan."""
    rows = [
        (
            f"{pair['first']} − {pair['second']}",
            with_interval(pair["mean_nm"], pair["ci95_nm"]),
            f"{pair['p']:.4f}",
            _over_prints(pair.get("over_prints")),
        )
        for pair in benchmark["paired"]
        if {pair["first"], pair["second"]} <= {"linear", *PAPER_MODELS}
    ]
    return markdown_table(
        ("difference", "datum-free error, k = 1, over scans", "p", "over prints"),
        rows,
        "On the pixels of the table above. Intervals resample scans, p is of a sign-flip test over scans: "
        "they need not agree at the border. Scans of a print are not independent; over six prints a "
        "sign-flip test cannot go below p = 0.031.",
    )


def _over_prints(units: dict[str, Any] | None) -> str:
    if units is None:
        return "not recorded"
    interval = "" if units["ci95_nm"] is None else "{:.2f} … {:.2f}, ".format(*units["ci95_nm"])
    return f"{interval}p = {units['p']:.3f} ({units['count']} prints)"


def paper_table(draws: Sequence[dict[str, Any]], grouped: dict[str, Any]) -> str:
    """Errors on every draw of the paper's split, one row per model, and how far the models are apart."""
    heads = ("model", *(f"draw {own['split']['seed']}" for own in draws))
    heads += ("absolute error, mean over draws", "whole scans held out")
    rows = []
    whole = {score["model"]: score["mae_datum_free_nm"] for score in grouped["scores"]}
    for name in [score["model"] for score in draws[0]["scores"]]:
        scores = [score for own in draws for score in own["scores"] if score["model"] == name]
        free = [with_interval(own["mae_datum_free_nm"], own["mae_datum_free_ci95_nm"]) for own in scores]
        absolute = sum(own["mae_abs_nm"] for own in scores) / len(scores)
        rows.append((name, *free, f"{absolute:.2f} nm", f"{whole[name]:.2f} nm"))
    rows.append(_floor_row(draws[0]["noise_floor"], len(heads)))
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
        f"quadrants at random and trains on the others ({_steps(draws[0])}); its number is the seed of split "
        f"and training. Leaky, as the paper's split is; the last column has the split by scan beside it. "
        f"{_order_of_draws(draws)} Quadrants of the "
        f"{len(split['lock_box'])} locked scans take part, in training and in the errors.",
    )


def extrapolation_table(by_print: dict[str, Any], by_scan: dict[str, Any]) -> str:
    """Errors where every scan of a print is held out, beside those where other scans of it are seen."""
    seen = {score["model"]: score for score in by_scan["scores"]}
    rows = []
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
    heads = ("model", "datum-free error, whole prints held out", "whole scans held out")
    heads += ("absolute error, whole prints held out", "whole scans held out")
    rows.append(_floor_row(by_print["noise_floor"], len(heads)))
    split = by_print["split"]
    missing = [name for name in seen if name not in {score["model"] for score in by_print["scores"]}]
    left_out = f" Not run: {', '.join(missing)}." if missing else ""
    return markdown_table(
        heads,
        rows,
        f"{split['folds']} folds, one per print, {len(split['scored_ids'])} scans; "
        f"the {len(split['lock_box'])} locked scans are in no fold.{left_out}",
    )


def further_table(benchmark: dict[str, Any]) -> str:
    """Phase, similarity, edges, crops, and training against held-out error, one row per model."""
    heads = ("model", "phase", "SSIM", "edges, mean", "edges, P95", "edges without partner")
    heads += ("other crop, largest", "on training scans", "on inner validation", "held out")
    rows = []
    for score in benchmark["scores"]:
        found = [fit["diagnostics"] for fit in benchmark["fits"] if fit["model"] == score["model"]]
        lost = score["edge_unmatched"] / (score["edge_matched"] + score["edge_unmatched"])
        crops = [entry["tiles"]["max_nm"] for entry in found if entry["tiles"]]
        errors = [
            _mean_nm([entry[key] for entry in found])
            for key in ("training_nm", "inner_validation_nm", "held_out_nm")
        ]
        rows.append(
            (
                score["model"],
                f"{score['phase_rms_waves']:.4f} waves",
                f"{score['ssim']:.3f}",
                f"{score['edge_mean_nm']:.0f} nm",
                f"{score['edge_p95_nm']:.0f} nm",
                f"{100 * lost:.1f} %",
                f"{max(crops):.2g} nm" if crops else "–",
                *errors,
            )
        )
    return markdown_table(
        heads,
        rows,
        "The definitions are in [how models are judged](../../evaluation.md). The last three columns are "
        "datum-free errors without the shared background, means over folds.",
    )


def noise_table(noise: dict[str, Any]) -> str:
    """What bounds the noise of the measured prints, one row per figure."""
    rows = [
        (
            bound["name"],
            bound["of"],
            bound["direction"],
            with_interval(bound["sigma_nm"], bound["ci95_nm"]),
            f"{bound['mae_nm']:.2f} nm",
        )
        for bound in noise["bounds"]
    ]
    floor = noise["noise_floor"]
    return markdown_table(
        ("estimate from", "noise", "what it is", "σ", "MAE"),
        rows,
        f"{noise['run']['n_scans']} development scans of the measured prints, 95 % intervals over scans. "
        f"No flat and no repeated print is among them: the floor, MAE {floor['mae_nm']:.2f} nm, is a "
        f"{floor['kind'].replace('-', ' ')}.",
    )


def design_table(gap: dict[str, Any]) -> str:
    """Image quality of every arm's hologram under every judge."""
    judges = list(dict.fromkeys(entry["judge"] for entry in gap["summary"]))
    found = {
        (entry["arm"], entry["judge"]): entry["judged_mean"]
        for entry in gap["summary"]
        if entry["figure"] == "si_psnr_db"
    }
    settings = gap["settings"]
    return markdown_table(
        ("designed with", *(f"judged by {judge}" for judge in judges)),
        [(arm, *(f"{found[arm, judge]:.2f} dB" for judge in judges)) for arm in gap["arms"]],
        "Scale-invariant PSNR of the hologram that the printed argmax layout makes, "
        f"{settings['layout']['size_px']} px, {settings['search']['iterations']} iterations, seeds "
        f"{gap['seeds']}: one small task, no ranking beyond it.",
    )


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


def _floor_row(floor: dict[str, Any], columns: int) -> tuple[str, ...]:
    kind = floor["kind"].replace("-", " ")
    return (f"noise floor ({kind})", f"{floor['mae_nm']:.2f} nm", *["–"] * (columns - 2))


def _steps(benchmark: dict[str, Any]) -> str:
    """Optimiser steps of the networks."""
    steps = {name: own["steps"] for name, own in benchmark["training"].items() if name in ("pbl", "fno")}
    return ", ".join(f"{name.upper()}: {count:,} steps" for name, count in steps.items())


def _mean_nm(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{sum(known) / len(known):.2f} nm" if known else "–"
