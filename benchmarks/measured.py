"""Carry the results of the measured run into the documentation: small files, tables, figures.

    make demo DATASET=neural-lithography
    python -m benchmarks.measured runs/neural-lithography

What the pages quote is written here from the result files, and a test holds the pages to them.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

from benchmarks.measured_figures import draw_prediction, draw_steps
from benchmarks.measured_loop import equal_freedom_table, locked_table, loop_table
from benchmarks.measured_models import (
    benchmark_table,
    coverage_table,
    design_table,
    further_table,
    headline_table,
    in_one,
    noise_table,
    paired_table,
    texture_table,
)
from benchmarks.measured_splits import extrapolation_table, paper_table, seeds_table
from benchmarks.record import publish
from examples.demo import PAPER_SEEDS, SMALL_BASES
from litho_data.foundation.commands import run_script
from litho_models.evaluation.zoo_making import ZOO_MODELS
from litho_models.frozen import zoo
from litho_models.frozen.card import ModelCard

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "results" / "neural-lithography"
TRAINING_SEEDS = (1, 2)
RESULTS = {
    "benchmark.json": "benchmark/benchmark.json",
    "benchmark_least_squares.json": "benchmark-small/benchmark.json",
    "benchmark_pbl.json": "benchmark-pbl/benchmark.json",
    **{f"benchmark_paper_{seed}.json": f"benchmark-paper-{seed}/benchmark.json" for seed in PAPER_SEEDS},
    "benchmark_prints.json": "leave-one-print-out/benchmark.json",
    "benchmark_prints_pbl.json": "leave-one-print-out-pbl/benchmark.json",
    **{
        f"benchmark_{network}_seed{seed}.json": f"benchmark-{network}-seed{seed}/benchmark.json"
        for network in ("pbl", "fno")
        for seed in TRAINING_SEEDS
    },
    "noise.json": "noise/noise.json",
    "close_loop.json": "close-loop/close_loop.json",
    **{f"close_loop_{base}.json": f"close-loop-{base}/close_loop.json" for base in (*SMALL_BASES, "pbl")},
    "close_loop_candidates.csv": "close-loop/candidates.csv",
    "close_loop_errors.csv": "close-loop/errors.csv",
    "gap.json": "compare/gap.json",
    "score.json": "score/score.json",
}
OF_MODELS = ("benchmark", "paired differences", "seeds", "whole prints", "paper split", "further figures")
OF_LOOPS = ("equal freedom", "loop", "loop with PBL", "locked scans", "design")
PAGES = {
    ROOT / "README.md": ("headline",),
    FOLDER / "README.md": (*OF_MODELS, *OF_LOOPS),
    ROOT / "docs" / "noise.md": ("noise", "texture", "coverage"),
}


def texts(folder: Path) -> dict[str, str]:
    """The text of each mark, from the result files in a folder and the cards of the zoo."""

    def found(file: str) -> dict[str, Any]:
        return json.loads((folder / file).read_text(encoding="utf-8"))

    # The draws of the paper's split are of the models of that run.
    first = found("benchmark.json")
    networks = in_one(found("benchmark.json"), found("benchmark_pbl.json"))
    by_print = in_one(found("benchmark_prints_pbl.json"), found("benchmark_prints.json"))
    benchmark = in_one(networks, found("benchmark_least_squares.json"))
    seeds = [
        in_one(*(found(f"benchmark_{network}_seed{seed}.json") for network in ("fno", "pbl")))
        for seed in TRAINING_SEEDS
    ]
    return {
        "headline": headline_table(benchmark, found("noise.json")),
        "equal freedom": equal_freedom_table(
            [found(f"close_loop{suffix}.json") for suffix in ("", *(f"_{b}" for b in (*SMALL_BASES, "pbl")))]
        ),
        "benchmark": benchmark_table(benchmark, found("noise.json")),
        "paper split": paper_table([found(f"benchmark_paper_{seed}.json") for seed in PAPER_SEEDS], first),
        "whole prints": extrapolation_table(by_print, benchmark, found("noise.json")),
        "seeds": seeds_table(networks, seeds),
        "paired differences": paired_table(benchmark),
        "further figures": further_table(benchmark),
        "noise": noise_table(found("noise.json")),
        "texture": texture_table(
            [found("noise.json")["budget"]["flat_texture"]],
            "Residuals where the layout is flattest, of 20 scans, each freed of offset, gain, tilt and bow.",
        ),
        "coverage": coverage_table(found("noise.json")),
        "loop": loop_table(found("close_loop.json")),
        "loop with PBL": loop_table(found("close_loop_pbl.json"), found("close_loop.json")),
        "locked scans": locked_table(
            found("close_loop.json"), [ModelCard.read(zoo.folder(name)) for name in ZOO_MODELS]
        ),
        "design": design_table(found("gap.json")),
    }


def main() -> None:
    """Copy, draw, publish."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, help="folder of `make demo DATASET=neural-lithography`")
    runs = parser.parse_args().runs
    made = [name for name, source in RESULTS.items() if (runs / source).exists()]
    for name in made:
        shutil.copyfile(runs / RESULTS[name], FOLDER / name)
    draw_steps(FOLDER / "close_loop_errors.csv", FOLDER / "loop_steps.png")
    if "benchmark_pbl.json" in made:
        draw_prediction(runs / "store.zarr", runs / "benchmark-pbl", FOLDER / "prediction.jpg")
    if kept := [name for name in RESULTS if name not in made]:
        print(f"not in {runs}, left as they were: {', '.join(kept)}")
    written = texts(FOLDER)
    for page, names in PAGES.items():
        for name in names:
            publish(page, name, written[name])


if __name__ == "__main__":
    run_script(main)
