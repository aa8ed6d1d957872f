"""Carry the results of the measured run into the documentation: small files, tables, figures.

    make demo DATASET=neural-lithography
    python benchmarks/measured.py runs/neural-lithography

What the pages quote is written here from the result files, and a test holds the pages to them.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

from benchmarks.measured_figures import draw_prediction, draw_steps
from benchmarks.record import publish

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "results" / "neural-lithography"
RESULTS = {
    "benchmark.json": "benchmark/benchmark.json",
    "close_loop.json": "close-loop/close_loop.json",
    "close_loop_pbl.json": "close-loop-pbl/close_loop.json",
    "close_loop_candidates.csv": "close-loop/candidates.csv",
    "gap.json": "compare/gap.json",
    "score.json": "score/score.json",
}
NAMES = ("benchmark", "loop", "loop with PBL", "design")
PAGES = {ROOT / "README.md": NAMES, FOLDER / "README.md": NAMES}


def benchmark_table(benchmark: dict[str, Any]) -> str:
    """Held-out errors of every model, one row each."""
    rows = [
        "| model | datum-free error (zero of each scan free) | with tilt, bow and gain free "
        "| absolute error | parameters |",
        "|---|---|---|---|---|",
    ]
    parameters = {fit["model"]: fit["parameters"] for fit in benchmark["fits"]}
    for score in benchmark["scores"]:
        policies = {entry["policy"]: entry["mae_nm"] for entry in score["by_policy"]}
        free = _with_interval(score["mae_datum_free_nm"], score["mae_datum_free_ci95_nm"])
        absolute = _with_interval(score["mae_abs_nm"], score["mae_abs_ci95_nm"])
        rows.append(
            f"| {score['model']} | {free} | {policies['full']:.2f} nm | {absolute} "
            f"| {parameters[score['model']]:,} |"
        )
    split = benchmark["split"]
    steps = benchmark["training"]["pbl"]["steps"]
    rows.append(
        f"\nMean absolute error on held-out scans ({len(split['scored_ids'])} scans, {split['folds']} folds "
        f"by scan, seed {split['seed']}, {len(split['lock_box'])} scans locked and not looked at; PBL: "
        f"{steps:,} steps), with 95 % bootstrap intervals over scans. Per-scan terms are fitted on pixels "
        "that are not scored."
    )
    return "\n".join(rows)


def loop_table(loop: dict[str, Any]) -> str:
    """The closed loop step by step, then what is left."""
    before, after = loop["before"], loop["after"]
    rows = [
        "| step | what it is | held-out error before | after | scans better |",
        "|---|---|---|---|---|",
    ]
    for effect in loop["effects"]:
        alike = f" or {', '.join(effect['confusable_with'])}" if effect["confusable_with"] else ""
        known = ", known before" if effect["prior_hypothesis"] else ""
        figure = "absolute" if effect["metric"] == "mae_abs" else "datum-free"
        better, count = effect["scans_improved"]
        rows.append(
            f"| `{effect['name']}`{alike} | {effect['role']}, {effect['verdict']}{known} "
            f"| {effect['before_nm']:.2f} nm ({figure}) | {effect['after_nm']:.2f} nm | {better} of {count} |"
        )
    rows.append(
        "\nA row need not begin where the last one ended: both sides of a process effect leave each scan's "
        "registration free, and both sides of one that acts as a gain go without the gain of single scans."
    )
    absorbed = [c["name"] for c in loop["candidates"] if c["verdict"] == "absorbed"]
    if absorbed:
        rows.append(f"\nFound on Physics and already carried by the network: {', '.join(absorbed)}.")
    rows.append(
        f"\nBase model {loop['base_model']}: datum-free {before['mae_datum_free_nm']:.2f} nm before, "
        f"{after['mae_datum_free_nm']:.2f} nm after, {loop['split']['folds']} folds by scan. "
        f"What is left: {loop['residual']['state']}"
        + (f"; it {loop['residual']['signature']}." if loop["residual"]["signature"] else ".")
    )
    return "\n".join(rows)


def design_table(gap: dict[str, Any]) -> str:
    """Image quality of every arm's hologram under every judge."""
    judges = list(dict.fromkeys(entry["judge"] for entry in gap["summary"]))
    rows = [
        f"| designed with | {' | '.join(f'judged by {judge}' for judge in judges)} |",
        "|---" * (len(judges) + 1) + "|",
    ]
    found = {
        (entry["arm"], entry["judge"]): entry["judged_mean"]
        for entry in gap["summary"]
        if entry["figure"] == "si_psnr_db"
    }
    for arm in gap["arms"]:
        rows.append(f"| {arm} | " + " | ".join(f"{found[arm, judge]:.2f} dB" for judge in judges) + " |")
    settings = gap["settings"]
    rows.append(
        "\nScale-invariant PSNR of the hologram that the printed argmax layout makes, "
        f"{settings['layout']['size_px']} px, {settings['search']['iterations']} iterations, seeds "
        f"{gap['seeds']}: one small task, no ranking beyond it."
    )
    return "\n".join(rows)


def texts(folder: Path) -> dict[str, str]:
    """The text of each mark, from the result files in a folder."""
    makers = {
        "benchmark": (benchmark_table, "benchmark.json"),
        "loop": (loop_table, "close_loop.json"),
        "loop with PBL": (loop_table, "close_loop_pbl.json"),
        "design": (design_table, "gap.json"),
    }
    return {
        name: make(json.loads((folder / file).read_text(encoding="utf-8")))
        for name, (make, file) in makers.items()
    }


def main() -> None:
    """Copy, draw, publish."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, help="folder of `make demo DATASET=neural-lithography`")
    runs = parser.parse_args().runs
    for name, source in RESULTS.items():
        shutil.copyfile(runs / source, FOLDER / name)
    draw_steps(runs / "close-loop" / "errors.csv", FOLDER / "loop_steps.png")
    draw_prediction(runs / "store.zarr", runs / "benchmark", FOLDER / "prediction.jpg")
    for page, names in PAGES.items():
        for name in names:
            publish(page, name, texts(FOLDER)[name])


def _with_interval(value: float, interval: list[float] | None) -> str:
    return f"{value:.2f} nm" + (f" ({interval[0]:.2f} … {interval[1]:.2f})" if interval else "")


if __name__ == "__main__":
    main()
