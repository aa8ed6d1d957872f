"""Does it help to weigh pixels by their uncertainty? Two benchmarks of the measured prints, side by side.

    litho-models benchmark STORE --models linear,features,physics --out UNIFORM
    litho-models benchmark STORE --models linear,features,physics --weights sigma --out SIGMA
    python -m benchmarks.weights UNIFORM SIGMA [--publish]

Both judge all pixels alike. --publish also writes the table into docs/evaluation.md.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin
from litho_data.foundation.commands import run_script
from litho_models.evaluation.compare import compare
from litho_models.evaluation.results import Benchmark

PAGE = Path(__file__).parents[1] / "docs" / "evaluation.md"
RESULT = PAGE.parent / "results" / "neural-lithography" / "weights.json"
NAME = "weights.json"


def main() -> None:
    """Compare, print, write."""
    parser = options(__doc__, "write the table into docs/evaluation.md")
    parser.add_argument("uniform", type=Path, help="result folder with uniform weights")
    parser.add_argument("sigma", type=Path, help="result folder with --weights sigma")
    parser.add_argument("--out", type=Path, default=RESULT, help="JSON file to write")
    arguments = parser.parse_args()
    results = [Benchmark.read(folder) for folder in (arguments.uniform, arguments.sigma)]
    table = compare(arguments.sigma, arguments.uniform)
    record = {
        "schema": "litho-models/benchmark-weights/1",
        **origin(),
        "commands": [one.run.command for one in results],
        "dataset": results[0].dataset.model_dump(),
        "scans": len(results[0].split.scored_ids),
        "folds": results[0].split.folds,
        "models": json.loads(table.to_json(orient="records")),
    }
    conclude(record, as_markdown(record), arguments.out, PAGE, NAME, published=arguments.publish)


def as_markdown(record: Mapping[str, Any]) -> str:
    """The two errors of each model and their difference, and what they rest on."""
    rows = [
        (
            f"`{one['first']}`",
            f"{one['second_nm']:.2f} nm",
            f"{one['first_nm']:.2f} nm",
            f"{one['difference_nm']:+.2f} nm ({one['low_nm']:+.2f} … {one['high_nm']:+.2f})",
            f"{one['p']:.4f}",
            one["first_better"],
        )
        for one in record["models"]
    ]
    heads = ("model", "uniform", "by σ", "by σ − uniform", "p", "scans better by σ")
    note = (
        f"Datum-free errors of all pixels alike, {record['scans']} scans in {record['folds']} folds; "
        "interval (95 %) and sign flips over scans."
    )
    return markdown_table(heads, rows, note)


if __name__ == "__main__":
    run_script(main)
