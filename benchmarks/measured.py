"""Copy the results for the measured prints into the documentation, as records, tables and a figure.

    make demo DATASET=neural-lithography
    python -m benchmarks.measured runs/neural-lithography

All tables on the pages are written from the copied records. A test checks that the pages agree with them.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from benchmarks.measured_figures import draw_prediction
from benchmarks.measured_models import benchmark_table, headline_table, in_one, noise_table
from benchmarks.record import options, publish
from examples.demo import PAPER_SEEDS
from litho_data.commands.progress import run_script

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
}
PAGES = {
    ROOT / "README.md": "headline",
    FOLDER / "README.md": "benchmark",
    ROOT / "docs" / "noise.md": "noise",
}


def texts(folder: Path) -> dict[str, str]:
    """Return the texts for the pages, by the names of their marks. They are made from the records in a
    folder.
    """
    benchmark, noise = in_table(folder), _found(folder, "noise.json")
    return {
        "headline": headline_table(benchmark, noise),
        "benchmark": benchmark_table(benchmark, noise),
        "noise": noise_table(noise),
    }


def in_table(folder: Path) -> dict[str, Any]:
    """Return the record of the benchmark that the table shows. It contains the newest result of each
    model.
    """
    networks = in_one(_found(folder, "benchmark.json"), _found(folder, "benchmark_pbl.json"))
    return in_one(networks, _found(folder, "benchmark_least_squares.json"))


def _found(folder: Path, file: str) -> dict[str, Any]:
    return json.loads((folder / file).read_text(encoding="utf-8"))


def main() -> None:
    """Copy the records, draw the figure, and write the tables into the pages."""
    parser = options(__doc__)
    parser.add_argument(
        "runs", type=Path, help="folder that `make demo DATASET=neural-lithography` has written"
    )
    runs = parser.parse_args().runs
    made = [name for name, source in RESULTS.items() if (runs / source).exists()]
    for name in made:
        shutil.copyfile(runs / RESULTS[name], FOLDER / name)
    if "benchmark_pbl.json" in made:
        draw_prediction(runs / "store.zarr", runs / "benchmark-pbl", FOLDER / "prediction.jpg")
    if kept := [name for name in RESULTS if name not in made]:
        print(f"these records are not in {runs}, so the published ones are kept: {', '.join(kept)}")
    written = texts(FOLDER)
    for page, name in PAGES.items():
        publish(page, name, written[name])


if __name__ == "__main__":
    run_script(main)
