"""Fit any model to measured scans. All fits of the commands, of the benchmark and of the closed loop are made
by this module.
"""

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
from litho_models.models import build_model, registered_sources
from litho_models.models.features import Features
from litho_models.models.pbl import Pbl
from litho_models.prediction.tiles import predict_scan
from litho_models.simulator import Simulator
from litho_models.splits.folds import inner_validation

# This small model is fitted first, by least squares. Its predictions are close to the data and give the first
# estimate of the per-scan terms when a network is trained.
FIRST_MODEL = "linear"


class FitFacts(Record):
    """Facts about a fit: the number of parameters of the model, the ids of its training and validation scans,
    and the duration of the fit.

    ``at_bounds`` contains the fitted values that lie on a bound of their range, as a dict from the name of
    the value to the bound.
    """

    parameters: int
    training_ids: list[str]
    validation_ids: list[str]
    seconds: float
    at_bounds: dict[str, float] = Field(default_factory=dict)


class Fitted(NamedTuple):
    """A fitted model, the facts of its fit, and the records of its training rounds. Least-squares fits have
    no rounds, so their list is empty.
    """

    model: Simulator
    facts: FitFacts
    history: list[RoundRecord]


def fit(
    model_name: str, scans: Sequence[PrintedScan], config: TrainingConfig, checkpoint: Path | None = None
) -> Fitted:
    """Fit a model to scans. The returned model is in eval mode.

    Args:
        model_name: a name in ``litho_models.models.MODELS``.
        scans: training scans, all with the same pitch, level height and number of levels.
        config: settings of the training and of the model.
        checkpoint: folder for checkpoints. If the folder holds the checkpoint of an interrupted run, the
            interrupted run is continued.

    Raises:
        InputError: the model is unknown; there are no scans, or their pitch, level height or number of levels
            differs; a setting contradicts the scans; the training diverged; or the checkpoint is damaged or
            belongs to another run.
    """
    geometry = common_geometry(scans)
    started = time.monotonic()
    torch.manual_seed(config.seed)
    for name in geometry.keys() & config.model.keys():
        raise InputError(
            f"setting {name}", got=config.model[name], wanted=f"{geometry[name]}, as in the scans"
        )
    model = build_model(model_name, config.variant, **geometry, **config.model)
    # The folder is checked even if this model writes no checkpoint, because it may contain the checkpoint of
    # another model.
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
        # The durations are summed over all recorded rounds, including those before an interruption.
        seconds=sum(entry.seconds for entry in history) or time.monotonic() - started,
        at_bounds=model.at_bounds,
    )
    return Fitted(model.eval(), facts, history)


def fit_in_cache(
    model_name: str, scans: Sequence[PrintedScan], config: TrainingConfig, cache: Path
) -> Fitted:
    """Fit a model as ``fit`` does. Checkpoints are kept in a subfolder of ``cache``. The name of the
    subfolder contains the key of the fit (see ``run_key``).

    A benchmark and a closed loop that train the same model on the same scans therefore train it only once.
    """
    untrained = build_model(model_name, config.variant, **common_geometry(scans))
    name = f"{model_name}-{run_key(untrained, scans, config)[:16]}"
    return fit(model_name, scans, config, cache / f"{name}.checkpoint")


def _first_predictions(scans: Sequence[PrintedScan], config: TrainingConfig) -> list[np.ndarray]:
    """Fit ``FIRST_MODEL`` to the scans, and return the heights, µm, that it predicts for them. The training
    of a network estimates its first per-scan terms from these heights.
    """
    geometry = common_geometry(scans)
    small = build_model(FIRST_MODEL, **geometry)
    if config.nuisance != "none":
        fit_small_model(small, scans, config.nuisance)
    return [predict_scan(small, scan) for scan in scans]


def run_key(
    model: Simulator, scans: Sequence[PrintedScan], config: TrainingConfig, held_out_ids: Sequence[str] = ()
) -> str:
    """Return the key of a fit: a hash of the model, its hyper-parameters, the settings of the training, the
    training scans, the ids of the held-out scans, and the code of registered models and parts.
    """
    settings = model.config.model_dump(mode="json")
    record = {
        "held_out_ids": list(held_out_ids),
        "model": model.name,
        "model_config": settings,
        "training": config.model_dump(mode="json"),
        "scans": scans_sha256(scans),
        **registered_sources(model.name, {**settings, **config.model}),
    }
    return record_sha256(record)


def scans_sha256(scans: Sequence[PrintedScan]) -> dict[str, str]:
    """Return the SHA-256 of each scan, as a dict with scan ids as keys."""
    return {scan.id: scan_sha256(scan) for scan in scans}


def common_geometry(scans: Sequence[PrintedScan]) -> dict[str, Any]:
    """Return the pitch, level height and number of levels that all scans share.

    Raises:
        InputError: there are no scans, or they differ in one of these values.
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
