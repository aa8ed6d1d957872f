"""The paper's recipe on the paper's models, its learning curves, and the fast recipe beside it, on one draw.

    python -m benchmarks.recipes STORE [--runs paper-pbl] --publish
    python -m benchmarks.recipes STORE --runs paper-physics,paper-pbl,paper-fno --epochs 4000 --publish

``--fast`` is the result of `litho-models benchmark STORE --split paper` with the fast recipe in float32; two
runs repeat it in bfloat16 and from another seed. An interrupted run resumes. The page shows all runs that are
published, those of earlier calls too; those of the paper's recipe have equal epochs. All 4,000 epochs of
the paper are a task for a GPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.learning_curves import STEPS_PER_EPOCH, curve_table, draw_curves
from benchmarks.markdown_table import markdown_table, with_interval
from benchmarks.record import options, publish
from litho_data.foundation.commands import run_script
from litho_data.foundation.errors import InputError
from litho_models.evaluation.benchmark import benchmark
from litho_models.evaluation.fit_cache import FitRecord
from litho_models.evaluation.results import Benchmark
from litho_models.fitting.config import PAPER_BATCH, PAPER_EPOCHS
from litho_models.scoring.pairs import paired_scores
from litho_models.scoring.records import ModelScores

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "results" / "recipes"
FAST = ROOT / "docs" / "results" / "neural-lithography" / "benchmark_paper_0.json"
PAGE, MARK = ROOT / "docs" / "evaluation.md", "recipes"
# What is compared with the fast recipe in float32: models and settings of each run. In bfloat16 a step of PBL
# takes half as long. The paper's models are as its appendix states them, and train in float32.
RUNS: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    "reduced": (("pbl",), {"precision": "bf16-mixed"}),
    "reseeded": (("pbl",), {"seed": 1}),
    "paper-physics": (("physics",), {"recipe": "paper", "variant": "paper"}),
    "paper-pbl": (("pbl",), {"recipe": "paper", "variant": "paper"}),
    "paper-fno": (("fno",), {"recipe": "paper", "variant": "paper"}),
}
CURVES = "learning_curves.png"


def main() -> None:
    """Train with the paper's recipe, print, write, publish."""
    parser = options(__doc__, "write table and results into the documentation")
    parser.add_argument("store", type=Path)
    parser.add_argument("--fast", type=Path, default=FAST, help="benchmark of the fast recipe, split paper")
    parser.add_argument("--runs", default=",".join(RUNS), help="names, separated by commas")
    parser.add_argument("--epochs", type=int, default=400, help="of the paper's 4,000")
    parser.add_argument("--out", type=Path, default=Path("runs/recipes"))
    given = parser.parse_args()
    fast = Benchmark.read(given.fast)
    runs, wanted = published_runs(), given.runs.split(",")
    if any(RUNS[name][1].get("recipe") == "paper" for name in wanted):
        kept = [result for name, result in runs.items() if name not in wanted]
        _require_equal_epochs(_paper_fits(kept), given.epochs)
    for name in wanted:
        models, settings = RUNS[name]
        if settings.get("recipe") == "paper":
            settings = {**settings, "steps": given.epochs * STEPS_PER_EPOCH}
        runs[name] = benchmark(
            given.store,
            given.out / name,
            split="paper",
            models=models,
            settings=settings,
            seed=fast.split.seed,
        )
    shown = [runs[name] for name in RUNS if name in runs]
    text = recipe_text(fast, shown)
    print(text)
    if given.publish:
        for name in wanted:
            runs[name].write(FOLDER / name)
        draw_curves(_paper_fits(shown), FOLDER / CURVES)
        publish(PAGE, MARK, text)


def _require_equal_epochs(kept: Sequence[FitRecord], epochs: int) -> None:
    """Curves and errors stand side by side, so all are of as many epochs."""
    others = {fit.steps[-1] // STEPS_PER_EPOCH for fit in kept} - {epochs}
    if others:
        paper = ",".join(name for name in RUNS if name.startswith("paper-"))
        raise InputError(
            f"--epochs {epochs}",
            got=f"published runs of {min(others):,} epochs beside it",
            wanted="the same for all runs of the paper's recipe",
            hint=f"--runs {paper}",
        )


def published_runs() -> dict[str, Benchmark]:
    """The committed results by name, in the order of `RUNS`."""
    return {name: Benchmark.read(FOLDER / name) for name in RUNS if (FOLDER / name).is_dir()}


def recipe_text(fast: Benchmark, others: Sequence[Benchmark]) -> str:
    """What the page shows: other ways of training beside the fast one; the models trained the paper's way."""
    picture = f"![Error by epoch of the models trained the paper's way](results/recipes/{CURVES})"
    curves = curve_table(_paper_fits(others))
    return "\n\n".join((recipe_table(fast, others), paper_order(others), picture, curves))


def _paper_fits(results: Sequence[Benchmark]) -> list[FitRecord]:
    return [
        fit for result in results for fit in result.fits if result.training[fit.model]["recipe"] == "paper"
    ]


def recipe_table(fast: Benchmark, others: Sequence[Benchmark]) -> str:
    """What other ways of training reach on the draw of the fast recipe, the paper's among them."""
    heads: tuple[str, ...] = ("model", "recipe", "steps", "10⁶ pixels seen", "on training scans", "held out")
    heads += ("more than fast", "p")
    rows = []
    for base in fast.scores:
        compared = [(other, own) for other in others for own in other.scores if own.model == base.model]
        rows += [_row(fast, base, ("", ""))] if compared else []
        for other, own in compared:
            rows.append(_row(other, own, _paired(own, base)))
    steps = max(fit.steps[-1] for fit in _paper_fits(others))
    return markdown_table(
        heads,
        rows,
        f"Datum-free errors. Split `paper`, seed {fast.split.seed}, "
        f"{len(fast.split.scored_ids)} quadrants held out. The paper's recipe after its first "
        f"{steps // STEPS_PER_EPOCH:,} of {PAPER_EPOCHS:,} epochs, {STEPS_PER_EPOCH} steps of {PAPER_BATCH} "
        "quadrants each. All choose the checkpoint on two quadrants of the training part. Error on training "
        "scans: without the shared background. Seed: of weights and crops.",
    )


def paper_order(others: Sequence[Benchmark]) -> str:
    """The models against each other, all trained with the paper's recipe: is the paper's order found?"""
    trained = [(other, score) for other in others for score in other.scores]
    own = sorted(
        (score for other, score in trained if other.training[score.model]["recipe"] == "paper"),
        key=lambda score: score.mae_datum_free_nm,
    )
    return markdown_table(
        ("with the paper's recipe", "datum-free error", "p"),
        [
            (f"{worse.model} − {better.model}", *_paired(worse, better))
            for place, better in enumerate(own)
            for worse in own[place + 1 :]
        ],
        "Paired differences of the runs with the paper's recipe in the table above. From best to worst: "
        f"{', '.join(score.model for score in own)}. In the paper pbl is the best.",
    )


def _paired(first: ModelScores, second: ModelScores) -> tuple[str, str]:
    """How much larger the first error is, quadrant by quadrant, and p."""
    paired = paired_scores(first, second)
    return with_interval(paired.mean_nm, paired.ci95_nm), f"{paired.p:.4f}"


def _row(result: Benchmark, score: ModelScores, difference: tuple[str, str]) -> tuple[str, ...]:
    settings = result.training[score.model]
    fit = next(fit for fit in result.fits if fit.model == score.model)
    how, steps, seen = [settings["recipe"]], "Gauss-Newton", "–"
    if fit.steps:
        how += [settings["precision"], f"seed {settings['seed']}"]
        how += [] if settings["variant"] == "default" else [f"variant {settings['variant']}"]
        steps = f"{fit.steps[-1]:,}"
        seen = f"{fit.steps[-1] * settings['batch'] * settings['crop_px'] ** 2 / 1e6:,.0f}"
    return (
        score.model,
        ", ".join(how),
        steps,
        seen,
        f"{fit.diagnostics.training_nm:.2f} nm" if fit.diagnostics else "–",
        with_interval(score.mae_datum_free_nm, score.mae_datum_free_ci95_nm),
        *difference,
    )


if __name__ == "__main__":
    run_script(main)
