"""Train the models that ship with the package, or check that they still score what their cards say.

    python examples/make_zoo.py prints.zarr --runs runs/zoo --benchmark runs/benchmark --open-lock-box
    python examples/make_zoo.py prints.zarr --check

Training sees all scans but the locked ones. ``--open-lock-box`` scores the locked ones: once per release.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from litho_data.commands.progress import run_script
from litho_models.evaluation.zoo_making import ZOO_MODELS, differing_metrics, make_zoo
from litho_models.frozen import zoo


def main() -> int:
    """Make or check; 1 if a card's metric is not reproduced."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("store", type=Path, help="dataset store of the measured prints")
    parser.add_argument("--zoo", type=Path, default=zoo.ZOO_FOLDER, help="folder to write, the package's own")
    parser.add_argument(
        "--runs", type=Path, default=Path("runs/zoo"), help="run folders; a killed run resumes"
    )
    parser.add_argument("--models", default=",".join(ZOO_MODELS), help="names, separated by commas")
    parser.add_argument("--recipe", choices=("fast", "paper"), default="fast")
    parser.add_argument("--steps", type=int, help="optimiser steps; the recipe's by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--benchmark", type=Path, help="grouped benchmark with the out-of-fold errors")
    parser.add_argument("--open-lock-box", action="store_true", help="score the locked scans too")
    parser.add_argument("--check", action="store_true", help="score the zoo again and compare with the cards")
    given = parser.parse_args()
    if given.check:
        found = differing_metrics(given.store, given.zoo)
        for name, lines in found.items():
            print(f"{name}: {'reproduced' if not lines else '; '.join(lines)}")
        return int(any(found.values()))
    cards = make_zoo(
        given.store,
        given.runs,
        given.zoo,
        models=given.models.split(","),
        recipe=given.recipe,
        steps=given.steps,
        seed=given.seed,
        open_lock_box=given.open_lock_box,
        benchmark=given.benchmark,
    )
    for name, card in cards.items():
        print(f"{name}: {card.parameters} parameters")
        for metric in card.metrics:
            print(f"  {metric.name:16} {metric.value:7.2f} nm  policy {metric.policy:11} {metric.split}")
    print(f"{given.zoo}: {zoo.size_bytes(given.zoo) / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_script(main))
