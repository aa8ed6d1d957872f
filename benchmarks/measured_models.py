"""Write the tables of the run on measured prints: errors of models on held-out scans, and the noise."""

from __future__ import annotations

from itertools import combinations
from typing import Any

from benchmarks.markdown_table import markdown_table, with_interval
from litho_models.scoring.records import ModelScores, paired_scores

_FREE = {
    "none": "nothing",
    "offset": "offset",
    "offset-gain": "offset, gain",
    "full": "offset, gain, tilt, bow",
    "full+rows": "offset, gain, tilt, bow, lines",
}


def in_one(older: dict[str, Any], newer: dict[str, Any]) -> dict[str, Any]:
    """Merge two benchmarks on the same scans: models of the newer one, and those that only the older one has.

    Networks take long to train, so a changed model is benchmarked again without the others.

    Raises:
        ValueError: the benchmarks differ in data, scans, folds or scan terms.
    """
    for key, parts in (
        ("dataset", ("sha256",)),
        ("split", ("kind", "folds", "seed", "scored_ids_sha256")),
        ("nuisance", ("policy", "k", "block_px", "buffer_px", "background")),
    ):
        for part in parts:
            if older[key][part] != newer[key][part]:
                raise ValueError(f"{key}.{part}: {older[key][part]}, {newer[key][part]}")
    new = {score["model"] for score in newer["scores"]}
    rows = {
        key: newer[key] + [row for row in older[key] if row["model"] not in new] for key in ("scores", "fits")
    }
    scores = [ModelScores.model_validate(score) for score in rows["scores"]]
    paired = [paired_scores(*pair).model_dump(mode="json") for pair in combinations(scores, 2)]
    return older | rows | {"paired": paired, "training": older["training"] | newer["training"]}


def benchmark_table(benchmark: dict[str, Any], noise: dict[str, Any]) -> str:
    """Return the table of held-out errors, one row per model, with the noise floor in the last row."""
    heads = (
        "model",
        "datum-free error (zero of each scan free, k = 1)",
        "the same without the shared background",
        "with tilt, bow and gain free, k = 7",
        "absolute error",
        "parameters",
    )
    rows: list[tuple[str, ...]] = []
    parameters = {fit["model"]: fit["parameters"] for fit in benchmark["fits"]}
    for score in benchmark["scores"]:
        policies = {entry["policy"]: entry["mae_nm"] for entry in score["by_policy"]}
        bare = {entry["policy"]: entry["mae_nm"] for entry in score["without_background"]}
        free = with_interval(score["mae_datum_free_nm"], score["mae_datum_free_ci95_nm"])
        absolute = with_interval(score["mae_abs_nm"], score["mae_abs_ci95_nm"])
        without, relaxed = f"{bare['offset']:.2f} nm", f"{policies['full']:.2f} nm"
        rows.append((score["model"], free, without, relaxed, absolute, f"{parameters[score['model']]:,}"))
    floor = noise["noise_floor"]
    rows.append(_floor_row(floor, "offset", None, "full", "none", None))
    split = benchmark["split"]
    return markdown_table(
        heads,
        rows,
        f"Mean absolute error on held-out scans ({len(split['scored_ids'])} scans, {split['folds']} folds "
        f"by scan, seed {split['seed']}; {len(split['lock_box'])} locked scans are in no fold and in no "
        f"figure of this table; {_steps_text(benchmark)}), with 95 % bootstrap intervals over scans. "
        "Per-scan terms are fitted on pixels that are not scored. Levelling leaves a shared background in "
        "every map. Its five numbers come from the training scans; it is added to predictions of measured "
        "maps, but not to designs. The noise is an upper estimate ([how](../../noise.md)); its intervals "
        "are over prints. A better model can reduce an error at least by its excess over the noise. "
        f"This excess at k = 1 and 7: {_above(benchmark, floor)}.",
    )


def headline_table(benchmark: dict[str, Any], noise: dict[str, Any]) -> str:
    """Return the table of a few models' errors, the noise and the paper's error, for the README."""
    parameters = {fit["model"]: fit["parameters"] for fit in benchmark["fits"]}
    scores = {score["model"]: score for score in benchmark["scores"]}
    rows: list[tuple[str, ...]] = []
    for name in ("affine", "physics", "pbl", "fno", "random-features"):
        score = scores[name]
        full = next(entry["mae_nm"] for entry in score["by_policy"] if entry["policy"] == "full")
        free = with_interval(score["mae_datum_free_nm"], score["mae_datum_free_ci95_nm"])
        rows.append((name, f"{parameters[name]:,}", free, f"{full:.2f} nm"))
    no_model = _floor_row(noise["noise_floor"], None, "offset", "full")
    rows.append(("what the layout cannot tell, at most", *no_model[1:]))
    rows.append(("PBL in the paper: other split, levelling and zero", "–", "24.35 nm, not comparable", "–"))
    split = benchmark["split"]
    return markdown_table(
        ("model", "parameters", "zero height free (k = 1)", "offset, gain, tilt and bow free (k = 7)"),
        rows,
        f"Mean absolute error over all valid pixels of {len(split['scored_ids'])} scans in {split['folds']} "
        "folds. Each is predicted by models not trained on it, plus the smooth background of their "
        "training scans. k terms are fitted to each scan, on pixels that are not scored. Intervals: "
        "95 %, over scans, or over the 6 prints in the last row but one. That row is an upper estimate: "
        "it includes errors common to a place, field or print.",
    )


def noise_table(noise: dict[str, Any]) -> str:
    """Return the noise of the measured prints by fitted scan terms, then by level where they are flat."""
    budget = noise["budget"]
    by_terms = markdown_table(
        ("free in each scan", "terms k", "noise, MAE", "noise, σ"),
        [
            (
                _FREE[row["policy"]],
                f"{row['k']:.0f}",
                with_interval(row["mae_nm"], row["mae_ci95_nm"]),
                with_interval(row["rmse_nm"], row["rmse_ci95_nm"]),
            )
            for row in budget["floor"]["by_policy"]
        ],
        f"{noise['run']['n_scans']} development scans of the measured prints, residuals of "
        f"`{budget['model']}`, all scored pixels, 95 % intervals over prints.",
    )
    by_level = markdown_table(
        ("level", "pixels", "σ where flat", "MAE where flat"),
        [
            (
                str(row["level"]),
                f"{row['pixels']:,}",
                with_interval(row["sigma_nm"], row["ci95_nm"]),
                f"{row['mae_nm']:.2f} nm",
            )
            for row in budget["flat_levels"]
        ],
        "The quarter of the pixels where the layout is flattest (slope at most "
        f"{budget['flat_slope']:.3f}); offset, gain, tilt, bow and lines of each scan are free.",
    )
    return f"{by_terms}\n\n{by_level}"


def _floor_row(floor: dict[str, Any], *policies: str | None) -> tuple[str, ...]:
    """Return a row with the noise for the scan terms of each column of errors; None leaves a cell empty."""
    rows = {row["policy"]: row for row in floor["by_policy"]}
    cells = [with_interval(rows[p]["mae_nm"], rows[p]["mae_ci95_nm"]) if p else "–" for p in policies]
    return (f"noise ({floor['kind'].replace('-', ' ')})", *cells)


def _above(benchmark: dict[str, Any], floor: dict[str, Any]) -> str:
    """Return how far the error of each model is above the noise with the same scan terms."""
    least = {row["policy"]: row["mae_nm"] for row in floor["by_policy"]}
    parts = []
    for score in benchmark["scores"]:
        errors = {entry["policy"]: entry["mae_nm"] for entry in score["by_policy"]}
        gaps = " and ".join(f"{errors[p] - least[p]:.2f}" for p in ("offset", "full"))
        parts.append(f"{score['model']} {gaps} nm")
    return ", ".join(parts)


def _steps_text(benchmark: dict[str, Any]) -> str:
    """Return the numbers of optimiser steps of the networks as text."""
    steps = {name: own["steps"] for name, own in benchmark["training"].items() if name in ("pbl", "fno")}
    return ", ".join(f"{name.upper()}: {count:,} steps" for name, count in steps.items())
