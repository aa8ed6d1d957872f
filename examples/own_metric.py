"""Add a metric of your own to an evaluation. It then appears in the results, the report and the tables.

    python examples/own_metric.py zoo:pbl STORE.zarr --out evaluation

The script registers a metric, the share of pixels whose error exceeds half a level. It then evaluates a model
as `litho-models evaluate` does. Nothing else needs to change: the metric appears in the JSON file,
`report.html`, `metrics.csv` and `scans.csv`.
"""

from __future__ import annotations

import argparse

import numpy as np

from litho_data.commands.progress import run_script
from litho_data.store import PrintedScan
from litho_models import evaluate, register_metric


def share_off_by_half_a_level(
    scan: PrintedScan, prediction_um: np.ndarray, residual_um: np.ndarray
) -> float | None:
    """Return the percentage of scored pixels whose error exceeds half a level, or None if no pixel is
    scored.
    """
    scored = residual_um[np.isfinite(residual_um)]
    return 100 * float(np.mean(np.abs(scored) > scan.level_height_um / 2)) if scored.size else None


def main() -> None:
    """Register the metric, evaluate the model, and print the metric."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", help="folder of a frozen model, or zoo:NAME")
    parser.add_argument("store", help="dataset store")
    parser.add_argument("--out", required=True, help="folder of the result")
    given = parser.parse_args()
    metric = register_metric(
        "off_by_half_a_level",
        "percent",
        share_off_by_half_a_level,
        "off_by_half_a_level is the share of pixels whose error exceeds half a level.",
    )
    scores = evaluate(given.model, given.store, given.out).scores
    print(
        f"{scores.model}: the error exceeds half a level in {scores.metrics[metric.key]:.1f} % of the pixels"
    )


if __name__ == "__main__":
    run_script(main)
