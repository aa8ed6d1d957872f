"""Train the models that ship with the package, or check that they still score what their cards say.

    python examples/make_zoo.py prints.zarr --runs runs/zoo --benchmark runs/benchmark --open-lock-box
    python examples/make_zoo.py prints.zarr --check

Training sees all scans but the locked ones. ``--open-lock-box`` scores the locked ones: once per release.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from litho_data.commands.progress import run_script
from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan, Store, open_store
from litho_models.evaluation.results import Benchmark
from litho_models.fitting.config import Recipe
from litho_models.fitting.runs import train
from litho_models.frozen import zoo
from litho_models.frozen.card import CardMetric, ModelCard
from litho_models.frozen.files import load_frozen
from litho_models.frozen.freezing import MODEL_FOLDER, freeze
from litho_models.frozen.on_store import card_background, predict_frozen
from litho_models.scan_terms import BackgroundUse, NuisanceProtocol, Policy
from litho_models.scoring.noise_floor import UNKNOWN_FLOOR
from litho_models.scoring.records import ModelScores, Prediction
from litho_models.scoring.scores import score_model
from litho_models.simulator import Variant

# What it may add to the package.
LARGEST_ZOO_BYTES = 8_000_000
ZOO_MODELS = ("physics", "pbl", "fno")
TRAINED_ON, HELD_OUT, OUT_OF_FOLD = "development, trained on", "lock box, held out", "grouped, out of fold"


def make_zoo(
    store: str | Path,
    runs: str | Path,
    root: str | Path = zoo.ZOO_FOLDER,
    *,
    models: Sequence[str] = ZOO_MODELS,
    recipe: Recipe = "fast",
    variant: Variant = "default",
    steps: int | None = None,
    seed: int = 0,
    open_lock_box: bool = False,
    benchmark: str | Path | None = None,
) -> dict[str, ModelCard]:
    """Train, score and freeze ``models``; an interrupted call resumes.

    Args:
        store: dataset store.
        runs: folder of the run folders.
        root: the zoo to write into, a folder per model.
        recipe, variant, steps, seed: as in ``litho-models train``, which makes the same weights.
        open_lock_box: score the locked scans too; once per release.
        benchmark: result of ``litho-models benchmark`` with split ``grouped``; its out-of-fold errors of
            the same models go into the cards, marked as those of other fits, and so does its noise floor.

    Raises:
        InputError: a store or benchmark that cannot be used, or a zoo that is too large.
    """
    dataset = open_store(store)
    every = dataset.scans()
    locked = dataset.locked_ids
    out_of_fold = _out_of_fold(benchmark, dataset) if benchmark is not None else {}
    floor = Benchmark.read(benchmark).noise_floor if benchmark is not None else UNKNOWN_FLOOR
    given = {"seed": seed, **({"steps": steps} if steps is not None else {})}
    cards = {}
    for name in models:
        run = Path(runs) / name
        train(store, name, run, recipe=recipe, variant=variant, settings=given)
        metrics = scored_metrics(run / MODEL_FOLDER, [s for s in every if s.id not in locked], TRAINED_ON)
        if open_lock_box:
            metrics += scored_metrics(run / MODEL_FOLDER, [s for s in every if s.id in locked], HELD_OUT)
        metrics += out_of_fold.get(name, [])
        card = ModelCard.read(run / MODEL_FOLDER)
        described = {
            "metrics": metrics,
            "command": _command(dataset.name, name, recipe, variant, given),
            "nuisance": NuisanceProtocol.of_policy("offset", background="training").model_dump(mode="json"),
            "noise_floor": floor.model_dump(mode="json"),
            "limitations": _limitations(metrics),
        }
        card.model_copy(update=described).write(run / MODEL_FOLDER)
        cards[name] = freeze(run, Path(root) / name)
    size = size_bytes(root)
    if size > LARGEST_ZOO_BYTES:
        raise InputError("size of the zoo", got=f"{size} bytes", wanted=f"at most {LARGEST_ZOO_BYTES}")
    return cards


def scored_metrics(model: str | Path, scans: Sequence[PrintedScan], split: str) -> list[CardMetric]:
    """The errors of a frozen model on scans, as in its card, the same for any number of threads."""
    frozen = load_frozen(model)
    learned = card_background(frozen, scans)
    protocol = NuisanceProtocol.of_policy("offset", background="training" if learned else "none")
    # Threads that share a sum add it up in another order, and its last bits differ.
    with threadpool_limits(1):
        predictions = [Prediction.beside(learned, predict_frozen(frozen, scan)) for scan in scans]
        scores = score_model(frozen.name, scans, predictions, protocol)
    return _metrics(scores, split, protocol.background)


def differing_metrics(store: str | Path, root: str | Path = zoo.ZOO_FOLDER) -> dict[str, list[str]]:
    """Score every zoo model again; per model, what differs from its card in any bit.

    Out-of-fold errors are of other fits and are not compared.

    Raises:
        InputError: a model of another dataset.
    """
    dataset = open_store(store)
    every = dataset.scans()
    locked = dataset.locked_ids
    found = {}
    for name in zoo.list(root):
        card = ModelCard.read(zoo.folder(name, root))
        if card.dataset is None or card.dataset.sha256 != dataset.sha256:
            raise InputError(f"dataset of zoo model {name}", got=card.dataset, wanted=dataset.sha256)
        stated = [metric for metric in card.metrics if metric.split in (TRAINED_ON, HELD_OUT)]
        again: list[CardMetric] = []
        for split, inside in ((TRAINED_ON, False), (HELD_OUT, True)):
            if any(metric.split == split for metric in stated):
                scans = [scan for scan in every if (scan.id in locked) == inside]
                again += scored_metrics(zoo.folder(name, root), scans, split)
        found[name] = [
            f"{old.name} ({old.policy}, {old.split}): card {old.value!r}, now {new.value!r}"
            for old, new in zip(stated, again, strict=True)
            if old != new
        ]
    return found


def size_bytes(root: str | Path) -> int:
    """What the zoo adds to the package."""
    return sum(file.stat().st_size for file in Path(root).rglob("*") if file.is_file())


def _metrics(scores: ModelScores, split: str, background: BackgroundUse) -> list[CardMetric]:
    """The metrics of a card, first with the background of the protocol, then without it."""

    def metric(name: str, value: float, policy: Policy, used: BackgroundUse) -> CardMetric:
        return CardMetric(name=name, value=value, split=split, policy=policy, background=used)

    return [
        metric("mae_abs", scores.mae_abs_nm, "none", background),
        metric("rmse_datum_free", scores.rmse_datum_free_nm, "offset", background),
        *(
            metric("mae_abs" if one.policy == "none" else "mae_datum_free", one.mae_nm, one.policy, used)
            for used, errors in ((background, scores.by_policy[1:]), ("none", scores.without_background))
            for one in errors
        ),
    ]


def _out_of_fold(benchmark: str | Path, dataset: Store) -> dict[str, list[CardMetric]]:
    result = Benchmark.read(benchmark)
    if (result.dataset.sha256, result.split.kind) != (dataset.sha256, "grouped"):
        raise InputError(
            f"benchmark {benchmark}",
            got=f"split {result.split.kind} of {result.dataset.name}",
            wanted=f"split grouped of {dataset.name}, the store given",
        )
    background = result.nuisance.background
    return {scores.model: _metrics(scores, OUT_OF_FOLD, background) for scores in result.scores}


def _limitations(metrics: Sequence[CardMetric]) -> list[str]:
    splits = {metric.split for metric in metrics}
    notes = ["Trained on prints of one machine, resist and protocol: retrain for any other."]
    if HELD_OUT not in splits:
        notes.append("The locked scans were not opened: no error is of scans that this model has not seen.")
    if OUT_OF_FOLD in splits:
        notes.append("Out-of-fold errors are of other fits with the same recipe, each on fewer scans.")
    return notes


def _command(dataset: str, model: str, recipe: str, variant: str, given: dict[str, Any]) -> str:
    options = {"model": model, "recipe": recipe, "variant": variant, **given, "out": model}
    return shlex.join(
        ["litho-models", "train", f"{dataset}.zarr", *(f"--{key}={value}" for key, value in options.items())]
    )


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
    print(f"{given.zoo}: {size_bytes(given.zoo) / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_script(main))
