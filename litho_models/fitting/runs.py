"""Train a model on the scans of a store and write a run folder. An interrupted run can be continued."""

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from litho_data.commands.progress import progress, say
from litho_data.commands.settings import refused
from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import require_known
from litho_data.foundation.results import Result
from litho_data.foundation.run_facts import RunInfo, run_info
from litho_data.store import PrintedScan, open_store
from litho_data.store.lock_box import ids_sha256
from litho_data.store.schema import DatasetId
from litho_models.fitting import TrainingConfig, fit
from litho_models.fitting.checkpoint import RoundRecord
from litho_models.fitting.config import Recipe
from litho_models.fitting.fit import FitFacts
from litho_models.fitting.processes import joined
from litho_models.frozen.files import save_frozen
from litho_models.frozen.freezing import MODEL_FOLDER
from litho_models.models import model_class
from litho_models.prediction.tiles import predict_scan
from litho_models.scan_terms.background import learn_background
from litho_models.scoring.printer_state import baseline_of
from litho_models.simulator import Variant

CHECKPOINT_FOLDER = "checkpoint"


class TrainingRun(FitFacts, Result):
    """The record of a training run, written as ``run.json``."""

    SCHEMA = "litho-models/run/1"
    FILE_NAME = "run.json"

    run: RunInfo
    dataset: DatasetId
    model: str
    config: TrainingConfig
    lock_box: list[str]
    history: list[RoundRecord]


def train(
    store: str | Path,
    model: str,
    out: str | Path,
    *,
    recipe: Recipe = "fast",
    variant: Variant = "default",
    settings: dict[str, Any] | None = None,
    use_lock_box: bool = False,
) -> TrainingRun:
    """Train a model on the scans of a store, and write the model and its record to a run folder. Repeating
    the call continues an interrupted run.

    Locked scans, which are reserved for a final test, are left out unless ``use_lock_box`` is set. Under
    ``torchrun``, the processes divide the crops of each step among themselves, and only the first process
    writes files.

    Args:
        store: dataset store; ``model``: name of a model; ``out``: folder for the run.
        recipe, variant: recipe of ``TrainingConfig``, and variant of the model.
        settings: values for fields of ``TrainingConfig`` or of the model's configuration, which replace the
            values of the recipe and the variant.

    Raises:
        InputError: the recipe, variant, model or a setting is unknown, the store cannot be read, or ``out``
            holds another run.
    """
    dataset = open_store(store)
    film = dataset.instrument == "sem"
    config = training_config(recipe, model, {"variant": variant, **(settings or {})}, film)
    scans = dataset.scans()
    lock_box = dataset.locked_ids
    locked = [] if use_lock_box else lock_box
    used = [scan for scan in scans if scan.id not in locked]
    folder = Path(out)
    facts: dict[str, Any] = {
        "dataset": dataset.dataset_id.model_dump(),
        "model": model,
        "config": config.model_dump(mode="json"),
        "lock_box": locked,
    }
    first = joined()[0] == 0
    with growing_folder(folder, TrainingRun.FILE_NAME, facts) if first else nullcontext():
        if first:
            say(f"training {model} on {len(used)} scans")
        fitted = fit(model, used, config, folder / CHECKPOINT_FOLDER)
        record = TrainingRun(
            run=run_info([config.seed], len(used)),
            history=fitted.history,
            **dict(fitted.facts),
            **facts,
        )
        if not first:
            return record
        heights = [predict_scan(fitted.model, scan) for scan in progress(used, "predicting")]
        save_frozen(
            fitted.model,
            folder / MODEL_FOLDER,
            dataset=record.dataset,
            training={
                **facts["config"],
                "scan_ids": [scan.id for scan in used],
                "validation_ids": record.validation_ids,
                "seconds": round(record.seconds, 1),
            },
            training_level_share=level_share(used),
            training_step_share=step_share(used),
            background=learn_background(used, heights),
            baseline=baseline_of(used, heights, held_out=False),
            command=record.run.command,
            split={
                "kind": "development",
                "lock_box": locked,
                "lock_box_sha256": ids_sha256(locked),
                "lock_box_files_sha256": sorted(dataset.files_sha256(lock_box).values()),
            },
            limitations=[
                "The error of this model is not known, because training does not evaluate it; run "
                "`litho-models evaluate`."
            ],
        )
        record.write(folder)
    return record


def training_config(
    recipe: Recipe, model: str, settings: dict[str, Any], film: bool = False
) -> TrainingConfig:
    """Check the settings of a training and return them. Entries of ``settings`` that are not fields of
    ``TrainingConfig`` must be fields of the model's configuration, and they are passed on to the model.
    ``film`` says whether the scans are micrographs of films.

    Raises:
        InputError: the recipe, the model or a field is unknown, or a value is out of range.
    """
    own = {name: value for name, value in settings.items() if name not in TrainingConfig.model_fields}
    known = [*TrainingConfig.model_fields, *model_class(model).Config.model_fields]
    for name in own:
        if "." not in name:
            require_known("setting of the training or the model", name, known)
    settings = {name: value for name, value in settings.items() if name not in own}
    if own:
        settings["model"] = {**settings.get("model", {}), **own}
    try:
        return TrainingConfig.of_recipe(recipe, model, film=film, **settings)
    except ValidationError as error:
        raise refused(error) from None


def level_share(scans: Sequence[PrintedScan]) -> list[float]:
    """Return, for each level, the share of pixels with this level in the layouts of all scans."""
    levels = np.concatenate([scan.mask_level.ravel() for scan in scans])
    return (np.bincount(levels, minlength=scans[0].levels) / levels.size).tolist()


def step_share(scans: Sequence[PrintedScan]) -> list[float]:
    """Compute the level difference of every pair of neighbouring layout pixels. Return the shares of the
    pairs with the differences 0, 1, 2 and so on. Pairs along rows and pairs along columns are counted
    together.
    """
    steps = np.concatenate(
        [np.abs(np.diff(scan.mask_level.astype(int), axis=axis)).ravel() for scan in scans for axis in (0, 1)]
    )
    return (np.bincount(steps, minlength=scans[0].levels) / steps.size).tolist()
