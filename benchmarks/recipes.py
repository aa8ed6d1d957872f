"""The fast recipe against the first epochs of the paper's: same models, same draw of the paper's split.

    python -m benchmarks.recipes STORE --publish

``--fast`` is the result of `litho-models benchmark STORE --split paper` with the fast recipe. A killed run
goes on where it stopped. All epochs of the paper, ``--epochs 4000``, are a task for a GPU.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.markdown_table import markdown_table, with_interval
from benchmarks.record import publish
from litho_models.benchmark import Benchmark, benchmark
from litho_models.metrics import paired_difference
from litho_models.score_records import ModelScores
from litho_models.training.config import PAPER_BATCH, PAPER_CROPS, PAPER_EPOCHS

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "results" / "recipes"
FAST = ROOT / "docs" / "results" / "neural-lithography" / "benchmark_paper_0.json"
PAGE, MARK = ROOT / "docs" / "evaluation.md", "recipes"
STEPS_PER_EPOCH = PAPER_CROPS // PAPER_BATCH


def main() -> None:
    """Train with the paper's recipe, print, write, publish."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("store", type=Path)
    parser.add_argument("--fast", type=Path, default=FAST, help="benchmark of the fast recipe, split paper")
    parser.add_argument("--models", default="physics,pbl", help="names, separated by commas")
    parser.add_argument("--epochs", type=int, default=400, help="of the paper's 4,000")
    parser.add_argument("--precision", choices=("32-true", "bf16-mixed"), default="32-true")
    parser.add_argument("--out", type=Path, default=Path("runs/recipes"))
    parser.add_argument(
        "--publish", action="store_true", help="write table and results into the documentation"
    )
    given = parser.parse_args()
    fast = Benchmark.read(given.fast)
    steps = given.epochs * STEPS_PER_EPOCH
    paper = benchmark(
        given.store,
        given.out,
        split="paper",
        models=given.models.split(","),
        settings={"recipe": "paper", "steps": steps, "precision": given.precision},
        seed=fast.split.seed,
    )
    text = recipe_table(fast, paper)
    print(text)
    if given.publish:
        paper.write(FOLDER)
        publish(PAGE, MARK, text)


def recipe_table(fast: Benchmark, paper: Benchmark) -> str:
    """What the two recipes reach with the same models on the same draw of the paper's split."""
    heads = ("model", "recipe", "steps", "10⁶ pixels seen", "datum-free error", "paper − fast", "p")
    rows = []
    for own in paper.scores:
        other = next(score for score in fast.scores if score.model == own.model)
        paired = paired_difference(
            [scan.mae_datum_free_nm for scan in own.scans],
            [scan.mae_datum_free_nm for scan in other.scans],
            seed=paper.split.seed,
        )
        difference = with_interval(paired.mean, paired.interval), f"{paired.p:.4f}"
        rows += [_row(fast, other, ("", "")), _row(paper, own, difference)]
    epochs = max(settings["steps"] for settings in paper.training.values()) // STEPS_PER_EPOCH
    return markdown_table(
        heads,
        rows,
        f"Split `paper`, seed {paper.split.seed}, variant `default`, {len(paper.split.scored_ids)} quadrants "
        f"held out. The paper's recipe after its first {epochs:,} of {PAPER_EPOCHS:,} epochs, "
        f"{STEPS_PER_EPOCH} steps of {PAPER_BATCH} quadrants each. Both choose the checkpoint on two "
        "quadrants of the training part.",
    )


def _row(result: Benchmark, score: ModelScores, difference: tuple[str, str]) -> tuple[str, ...]:
    settings = result.training[score.model]
    rounds = next(fit.steps for fit in result.fits if fit.model == score.model)
    pixels = settings["batch"] * settings["crop_px"] ** 2
    return (
        score.model,
        f"{settings['recipe']}, {settings['precision']}" if rounds else settings["recipe"],
        f"{rounds[-1]:,}" if rounds else "Gauss-Newton",
        f"{rounds[-1] * pixels / 1e6:,.0f}" if rounds else "–",
        with_interval(score.mae_datum_free_nm, score.mae_datum_free_ci95_nm),
        *difference,
    )


if __name__ == "__main__":
    main()
