"""Fit any model to printed scans, for commands, benchmark and loop."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import record_sha256
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_data.store.printed_scan import scan_sha256
from litho_models.fitting.checkpoint import CheckpointFolder, RoundRecord
from litho_models.fitting.config import TrainingConfig
from litho_models.fitting.pixels import fit_feature_networks
from litho_models.fitting.ridge import fit_ridge
from litho_models.fitting.small_models import fit_small_model
from litho_models.fitting.stochastic import train_network
from litho_models.models import build_model
from litho_models.models.features import Features
from litho_models.models.pbl import Pbl
from litho_models.prediction.tiles import predict_scan
from litho_models.simulator import Simulator
from litho_models.splits.folds import inner_validation

# A model that is fitted in closed form and is close to the data. Its predictions give the first estimate of
# the scan terms for a network.
FIRST_MODEL = "linear"


class FitFacts(Record):
    """The scans on which a model was trained and validated, its number of parameters, and the time of the
    fit.

    ``at_bounds`` maps each fitted value that lies on a bound of its range to this bound.
    """

    parameters: int
    training_ids: list[str]
    validation_ids: list[str]
    seconds: float
    at_bounds: dict[str, float] = Field(default_factory=dict)


class Fitted(NamedTuple):
    """A fitted model and the history of its fit, which is empty for models without rounds."""

    model: Simulator
    facts: FitFacts
    history: list[RoundRecord]


def fit(
    model_name: str, scans: Sequence[PrintedScan], config: TrainingConfig, checkpoint: Path | None = None
) -> Fitted:
    """Fit a model to scans and return it in eval mode.

    Args:
        model_name: one of ``litho_models.models.MODELS``.
        scans: training scans, all with the same pitch, level height and number of levels.
        config: recipe, variant, seed, nuisances, settings of the model.
        checkpoint: folder of checkpoints, from which an interrupted run continues.

    Raises:
        InputError: an unknown model, no scans, scans that differ in these properties, or a checkpoint that is
            damaged or belongs to another run.
    """
    geometry = common_geometry(scans)
    started = time.monotonic()
    torch.manual_seed(config.seed)
    for name in geometry.keys() & config.model.keys():
        raise InputError(
            f"setting {name}", got=config.model[name], wanted=f"{geometry[name]}, as in the scans"
        )
    model = build_model(model_name, config.variant, **geometry, **config.model)
    # The folder is checked even if this model writes no checkpoint: it may contain that of another model.
    folder = None if checkpoint is None else CheckpointFolder(checkpoint, run_key(model, scans, config))
    ids = [scan.id for scan in scans]
    history: list[RoundRecord] = []
    validation_ids: list[str] = []
    if config.takes_steps(model):
        validation_ids = inner_validation(ids, config.validation_scans, config.seed)
        training = [scan for scan in scans if scan.id not in validation_ids]
        validation = [scan for scan in scans if scan.id in validation_ids]
        by_steps = model.chain() if isinstance(model, Pbl) else model
        history = train_network(
            by_steps, training, validation, config, lambda: _first_predictions(training, config), folder
        )
        if isinstance(model, Pbl) and model.feature_networks:
            model.take(by_steps)
            history.append(fit_feature_networks(model, training, validation, config))
    elif isinstance(model, Features):
        fit_ridge(model, scans, config.nuisance)
    else:
        fit_small_model(model, scans, config.nuisance)
    facts = FitFacts(
        parameters=model.parameter_count,
        training_ids=[scan_id for scan_id in ids if scan_id not in validation_ids],
        validation_ids=validation_ids,
        # This time includes the part of the training before an interruption.
        seconds=sum(entry.seconds for entry in history) or time.monotonic() - started,
        at_bounds=model.at_bounds,
    )
    return Fitted(model.eval(), facts, history)


def fit_in_cache(
    model_name: str, scans: Sequence[PrintedScan], config: TrainingConfig, cache: Path
) -> Fitted:
    """Fit as ``fit`` does, but keep the checkpoints in a folder of ``cache`` that is named after the fit's
    key.

    A benchmark and a loop that train the same model on the same scans thus reuse each other's fits.
    """
    untrained = build_model(model_name, config.variant, **common_geometry(scans))
    name = f"{model_name}-{run_key(untrained, scans, config)[:16]}"
    return fit(model_name, scans, config, cache / f"{name}.checkpoint")


def _first_predictions(scans: Sequence[PrintedScan], config: TrainingConfig) -> list[np.ndarray]:
    """Fit a small model to the scans, and return the heights that it predicts. The first scan terms of a
    network are estimated from these heights.
    """
    small = build_model(FIRST_MODEL, **common_geometry(scans))
    if config.nuisance != "none":
        fit_small_model(small, scans, config.nuisance)
    return [predict_scan(small, scan) for scan in scans]


def run_key(
    model: Simulator, scans: Sequence[PrintedScan], config: TrainingConfig, held_out_ids: Sequence[str] = ()
) -> str:
    """Return the hash of everything that determines a fit: model, hyper-parameters, settings, training scans
    and held-out scans.
    """
    record = {
        "held_out_ids": list(held_out_ids),
        "model": model.name,
        "model_config": model.config.model_dump(mode="json"),
        "training": config.model_dump(mode="json"),
        "scans": scans_sha256(scans),
    }
    return record_sha256(record)


def scans_sha256(scans: Sequence[PrintedScan]) -> dict[str, str]:
    """Return the SHA-256 of each scan, by scan id."""
    return {scan.id: scan_sha256(scan) for scan in scans}


def common_geometry(scans: Sequence[PrintedScan]) -> dict[str, Any]:
    """Return the pitch, level height and number of levels that all scans share.

    Raises:
        InputError: no scans, or scans that differ.
    """
    if not scans:
        raise InputError("training scans", got="none", wanted="at least one")
    found = sorted({(scan.pitch_um, scan.level_height_um, scan.levels) for scan in scans})
    if len(found) > 1:
        raise InputError(
            "pitch_um, level_height_um, levels of the scans", got=found, wanted="the same in all"
        )
    pitch, level_height, levels = found[0]
    return {"pitch_um": pitch, "level_height_um": level_height, "levels": levels}
