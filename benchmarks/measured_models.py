"""Write the tables for the measured prints: the errors of the models on held-out scans, and the noise."""

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
    """Merge the records of two benchmarks on the same scans. For a model that is in both, the newer result is
    used.

    Training a network takes long. Therefore, if a model has changed, only this model is benchmarked again.

    Raises:
        ValueError: the benchmarks differ in their data, scans, folds or in the terms fitted to each scan.
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
    """Return the table of the errors on held-out scans, with one row per model and the noise in the last
    row.
    """
    heads = (
        "model",
        "datum-free error (offset fitted to each scan, k = 1)",
        "datum-free error without the shared background",
        "error with gain, tilt and bow also fitted (k = 7)",
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
        f"Mean absolute error on {len(split['scored_ids'])} held-out scans ({split['folds']} folds of scans, "
        f"seed {split['seed']}; {_steps_text(benchmark)}). Brackets contain 95 % intervals from "
        f"resampling scans. The {len(split['lock_box'])} locked scans belong to no fold and affect no number "
        "here. The k terms of each scan are fitted to pixels that are not scored. After levelling, all maps "
        "contain the same smooth background. Its five coefficients are fitted to the training scans. It is "
        "added to predictions of measured maps, but not to designs. The noise is an upper estimate "
        "([how](../../noise.md)), and its intervals come from resampling prints. A better model can remove "
        "at least the part of an error that exceeds the noise. For each model, this part at k = 1 and at "
        "k = 7 is: "
        f"{_above(benchmark, floor)}.",
    )


def headline_table(benchmark: dict[str, Any], noise: dict[str, Any]) -> str:
    """Return the table in the README, with the errors of a few models, the noise, and the error in the
    paper.
    """
    parameters = {fit["model"]: fit["parameters"] for fit in benchmark["fits"]}
    scores = {score["model"]: score for score in benchmark["scores"]}
    rows: list[tuple[str, ...]] = []
    for name in ("affine", "physics", "pbl", "fno", "random-features"):
        score = scores[name]
        full = next(entry["mae_nm"] for entry in score["by_policy"] if entry["policy"] == "full")
        free = with_interval(score["mae_datum_free_nm"], score["mae_datum_free_ci95_nm"])
        rows.append((name, f"{parameters[name]:,}", free, f"{full:.2f} nm"))
    no_model = _floor_row(noise["noise_floor"], None, "offset", "full")
    rows.append(("what the layout cannot explain (upper estimate)", *no_model[1:]))
    rows.append(("PBL in the paper (other split, levelling and zero)", "–", "24.35 nm, not comparable", "–"))
    split = benchmark["split"]
    return markdown_table(
        ("model", "parameters", "offset fitted (k = 1)", "offset, gain, tilt and bow fitted (k = 7)"),
        rows,
        f"Mean absolute error over all valid pixels of {len(split['scored_ids'])} scans in {split['folds']} "
        "folds. Each scan is predicted by a model and a smooth background, both fitted to other scans. "
        "Then k terms are fitted to the scan, on pixels that are not scored. Brackets contain "
        "95 % intervals from resampling scans. For what the layout cannot explain, the 6 prints are "
        "resampled; this value includes errors that depend on place, field or print.",
    )


def noise_table(noise: dict[str, Any]) -> str:
    """Return two tables of the noise of the measured prints: by the terms fitted to each scan, and by the
    level of flat areas.
    """
    budget = noise["budget"]
    by_terms = markdown_table(
        ("fitted to each scan", "terms k", "noise, MAE", "noise, σ"),
        [
            (
                _FREE[row["policy"]],
                f"{row['k']:.0f}",
                with_interval(row["mae_nm"], row["mae_ci95_nm"]),
                with_interval(row["rmse_nm"], row["rmse_ci95_nm"]),
            )
            for row in budget["floor"]["by_policy"]
        ],
        f"The noise is computed from the residuals of `{budget['model']}` at all scored pixels of "
        f"{noise['run']['n_scans']} unlocked scans of the measured prints. Brackets contain 95 % intervals "
        "from resampling prints.",
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
        "Only the flattest quarter of all layout pixels is used, in which the slope is at most "
        f"{budget['flat_slope']:.3f}. Offset, gain, tilt, bow and line offsets are fitted to each scan.",
    )
    return f"{by_terms}\n\n{by_level}"


def _floor_row(floor: dict[str, Any], *policies: str | None) -> tuple[str, ...]:
    """Return the row of the noise, with a cell for each policy, which names the terms fitted to each scan.
    The cell for None is a dash.
    """
    rows = {row["policy"]: row for row in floor["by_policy"]}
    cells = [with_interval(rows[p]["mae_nm"], rows[p]["mae_ci95_nm"]) if p else "–" for p in policies]
    return (f"noise ({floor['kind'].replace('-', ' ')})", *cells)


def _above(benchmark: dict[str, Any], floor: dict[str, Any]) -> str:
    """Return a text that states by how much the error of each model exceeds the noise, at k = 1 and at k =
    7.
    """
    least = {row["policy"]: row["mae_nm"] for row in floor["by_policy"]}
    parts = []
    for score in benchmark["scores"]:
        errors = {entry["policy"]: entry["mae_nm"] for entry in score["by_policy"]}
        gaps = " and ".join(f"{errors[p] - least[p]:.2f}" for p in ("offset", "full"))
        parts.append(f"{score['model']} {gaps} nm")
    return ", ".join(parts)


def _steps_text(benchmark: dict[str, Any]) -> str:
    """Return a text that states for how many steps of the optimiser each network was trained."""
    steps = {name: own["steps"] for name, own in benchmark["training"].items() if name in ("pbl", "fno")}
    return ", ".join(f"{name.upper()}: {count:,} steps" for name, count in steps.items())
