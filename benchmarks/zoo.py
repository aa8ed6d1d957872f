"""Make the models that come with the package (the zoo). They are the models of the benchmark table, trained
in the same way.

    make zoo
    python -m benchmarks.zoo runs/zoo --models pbl,fno

Training uses all scans except the locked ones. A finished training run is reused, and an interrupted one
continues. The card of each model first lists the errors from the table, which are those of five other fits,
each of them to fewer scans.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.measured import FOLDER, ROOT, in_table
from benchmarks.record import options
from litho_data import build_dataset
from litho_data.commands.progress import run_script
from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan, open_store
from litho_models.evaluation.results import Benchmark
from litho_models.fitting.runs import TrainingRun, train
from litho_models.frozen import zoo
from litho_models.frozen.card import OUT_OF_FOLD, TRAINED_ON, Attribution, CardMetric, ModelCard
from litho_models.frozen.files import README_FILE, load_frozen
from litho_models.frozen.freezing import SCAN_AXIS, freeze
from litho_models.frozen.on_store import card_background, predict_frozen
from litho_models.scan_terms import BackgroundUse, NuisanceProtocol
from litho_models.scoring.records import ModelScores, Prediction
from litho_models.scoring.scores import score_model

CARD = ROOT / "datasets" / "neural-lithography.toml"
LARGEST_ZOO_BYTES = 10_000_000
# For these models, the parts that are attributed to the printer when the model is frozen. The errors in the
# table are those of PBL with its scan-axis network, so the frozen model includes it. The measured prints
# cannot show whether the printer or the microscope causes what this network describes.
WHOLE: dict[str, dict[str, Attribution]] = {"pbl": {SCAN_AXIS: "printer"}}
LIMITATIONS = [
    "Trained on prints of one machine, resist and protocol. Retrain the model for any other.",
    "The locked scans were not used in training.",
    "The out-of-fold errors are those of other fits with the same settings, each to fewer scans.",
]


def make_zoo(
    store: str | Path,
    runs: str | Path,
    table: Benchmark,
    root: str | Path = zoo.ZOO_FOLDER,
    models: Sequence[str] = (),
) -> dict[str, ModelCard]:
    """Train the models of a benchmark table, freeze them, and write their cards. Return the cards by name.

    If a call was interrupted, another call continues it.

    Args:
        store: path of the dataset store.
        runs: folder of the training runs, with a folder for each model.
        table: record of a benchmark on this store with the split ``grouped``.
        root: folder of the zoo, with a folder for each model.
        models: names of the models to make; by default, all models of the table.

    Raises:
        InputError: the table belongs to another dataset or split, a model was trained on other data or with
            other settings than in the table, or the zoo is too large.
    """
    dataset = open_store(store)
    if (table.dataset.sha256, table.split.kind) != (dataset.sha256, "grouped"):
        raise InputError(
            "table of the zoo",
            got=f"split {table.split.kind} of {table.dataset.name}",
            wanted=f"split grouped of the given store, {dataset.name}",
        )
    scans = [scan for scan in dataset.scans() if scan.id not in dataset.locked_ids]
    scores = {row.model: row for row in table.scores}
    cards = {}
    for name in models or scores:
        run, folder = Path(runs) / name, Path(root) / name
        trained = TrainingRun.read(run) if (run / TrainingRun.FILE_NAME).exists() else train(store, name, run)
        settings = trained.config.model_dump(mode="json") | {"dataset": trained.dataset.sha256}
        _require_settings(name, settings, table.training[name] | {"dataset": dataset.sha256})
        card = freeze(run, folder, WHOLE.get(name))
        protocol, own = _scored(folder, scans)
        described: dict[str, Any] = {
            "metrics": [*card_metrics(scores[name], OUT_OF_FOLD), *card_metrics(own, TRAINED_ON)],
            "command": f"litho-models train {dataset.name}.zarr --model={name} --out={name}",
            "nuisance": protocol.model_dump(mode="json"),
            "limitations": LIMITATIONS,
        }
        cards[name] = card.model_copy(update=described)
        cards[name].write(folder)
        (folder / README_FILE).write_text(cards[name].page, encoding="utf-8")
    size = size_bytes(root)
    if size > LARGEST_ZOO_BYTES:
        raise InputError("size of the zoo", got=f"{size} bytes", wanted=f"at most {LARGEST_ZOO_BYTES}")
    return cards


def card_metrics(scores: ModelScores, split: str) -> list[CardMetric]:
    """Return the errors of one model for its card, in the order of the table's columns."""
    bare = {row.policy: row for row in scores.without_background}
    used: BackgroundUse = "training" if bare else "none"
    free = {row.policy: row for row in scores.by_policy}
    columns = [
        (free["offset"], used),
        *[(bare["offset"], "none")] * bool(bare),
        (free["full"], used),
        (free["none"], used),
    ]
    return [
        CardMetric(
            name="mae_abs" if row.policy == "none" else "mae_datum_free",
            value=row.mae_nm,
            ci95=row.ci95_nm,
            split=split,
            policy=row.policy,
            background=background,
        )
        for row, background in columns
    ]


def size_bytes(root: str | Path) -> int:
    """Return the total size of all files of the zoo, in bytes."""
    return sum(file.stat().st_size for file in Path(root).rglob("*") if file.is_file())


def _scored(folder: Path, scans: Sequence[PrintedScan]) -> tuple[NuisanceProtocol, ModelScores]:
    """Score a frozen model on scans. The background in its card is added to its predictions.

    Return the protocol of the scoring, and the scores.
    """
    model = load_frozen(folder)
    learned = card_background(model, scans)
    predictions = [Prediction.beside(learned, scan, predict_frozen(model, scan)) for scan in scans]
    protocol = NuisanceProtocol.of_policy("offset", background="training" if learned else "none")
    return protocol, score_model(model.name, scans, predictions, protocol)


def _require_settings(name: str, trained: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Check that a model was trained on the data and with the settings of the table.

    Raises:
        InputError: a setting differs.
    """
    for key, value in wanted.items():
        # The optimiser is not compared, because fits by least squares do not use it.
        if key != "optimiser" and trained[key] != value:
            raise InputError(f"{key} of {name}", got=trained[key], wanted=f"{value}, as in the table")


def main() -> None:
    """Build the store if it does not exist, make the models, and print their errors."""
    parser = options(__doc__)
    parser.add_argument("runs", type=Path, help="folder of the store and of the training runs")
    parser.add_argument(
        "--models", help="names of the models, separated by commas; by default, all models of the table"
    )
    given = parser.parse_args()
    store = given.runs / "neural-lithography.zarr"
    if not store.exists():
        build_dataset(CARD, store)
    table = Benchmark.model_validate(in_table(FOLDER))
    cards = make_zoo(store, given.runs, table, models=given.models.split(",") if given.models else ())
    for name, card in cards.items():
        print(f"{name:16} {card.parameters:9,} parameters")
        for metric in card.metrics:
            print(f"  {metric.name:16} {metric.text:28} policy {metric.policy:8} {metric.split}")
    print(f"{zoo.ZOO_FOLDER.name}: {size_bytes(zoo.ZOO_FOLDER) / 1e6:.2f} MB")


if __name__ == "__main__":
    run_script(main)
