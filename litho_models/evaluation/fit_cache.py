"""Where a benchmark keeps its fits: what each predicted of its held-out scans, its record, its diagnostics.

Each (model, fold) is a folder of its own, named by the hash of everything that decides it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field

from litho_data.foundation.files import atomic_file, atomic_folder
from litho_data.foundation.results import Record
from litho_models.evaluation.diagnostics import FitDiagnostics, diagnose
from litho_models.fitting import Fitted, TrainingConfig, fit_in_cache
from litho_models.fitting.checkpoint import reading_kept
from litho_models.fitting.fit import common_geometry, run_key
from litho_models.models import build_model
from litho_models.prediction.tiles import predict_scan
from litho_models.splits.folds import Fold

_FIT, _DIAGNOSTICS, _PREDICTION = "fit.json", "diagnostics.json", "prediction_{:03d}.npy"


class FitRecord(Record):
    """One fit: what it saw and what it cost; errors are nm, None where the model has no rounds.

    ``at_bounds`` are fitted values on a bound of their range, and that bound. ``diagnostics`` are None in
    older result files.
    """

    model: str
    fold: int
    key: str
    training_ids: list[str]
    validation_ids: list[str]
    held_out_ids: list[str]
    parameters: int
    seconds: float
    steps: list[int]
    training_mae_nm: list[float]
    validation_mae_datum_free_nm: list[float | None]
    at_bounds: dict[str, float] = Field(default_factory=dict)
    diagnostics: FitDiagnostics | None = None


def fit_or_load(
    name: str, fold: Fold, config: TrainingConfig, cache: Path
) -> tuple[FitRecord, list[np.ndarray]]:
    """One fit and its heights (ny, nx) of the held-out scans, µm; made only if the cache has none.

    Raises:
        InputError: a kept fit that cannot be read.
    """
    untrained = build_model(name, config.variant, **common_geometry(fold.training))
    key = run_key(untrained, fold.training, config, [scan.id for scan in fold.held_out])
    folder = fit_folder(cache, name, key)
    if not ((folder / _FIT).exists() and (folder / _DIAGNOSTICS).exists()):
        # A finished training is read from its checkpoint; a small model is fitted again.
        fitted = fit_in_cache(name, fold.training, config, cache)
        if not (folder / _FIT).exists():
            _keep_fit(folder, fitted, fold, key)
        _, heights = kept_fit(folder)
        found = diagnose(fitted.model, fold.training, fitted.validation_ids, fold.held_out, heights)
        with atomic_file(folder / _DIAGNOSTICS) as temporary:
            temporary.write_text(found.model_dump_json(indent=1), encoding="utf-8")
    record, heights = kept_fit(folder)
    with reading_kept(folder):
        diagnostics = FitDiagnostics.model_validate_json((folder / _DIAGNOSTICS).read_bytes())
    return record.model_copy(update={"diagnostics": diagnostics}), heights


def fit_folder(cache: Path, name: str, key: str) -> Path:
    """The folder of a fit."""
    return cache / f"{name}-{key[:16]}"


def kept_fit(folder: Path) -> tuple[FitRecord, list[np.ndarray]]:
    """The record of a fit and its heights (ny, nx) of ``held_out_ids``, µm; without diagnostics.

    Raises:
        InputError: files that are missing or damaged.
    """
    with reading_kept(folder):
        record = FitRecord.model_validate_json((folder / _FIT).read_bytes())
        files = [folder / _PREDICTION.format(number) for number in range(len(record.held_out_ids))]
        return record, [np.load(file, allow_pickle=False) for file in files]


def _keep_fit(folder: Path, fitted: Fitted, fold: Fold, key: str) -> None:
    record = FitRecord(
        model=fitted.model.name,
        fold=fold.number,
        key=key,
        training_ids=fitted.training_ids,
        validation_ids=fitted.validation_ids,
        held_out_ids=[scan.id for scan in fold.held_out],
        parameters=fitted.model.parameter_count,
        seconds=fitted.seconds,
        steps=[entry.step for entry in fitted.history],
        at_bounds=fitted.model.at_bounds,
        training_mae_nm=[entry.training_mae_nm for entry in fitted.history],
        validation_mae_datum_free_nm=[entry.validation_mae_datum_free_nm for entry in fitted.history],
    )
    with atomic_folder(folder) as temporary:
        for number, scan in enumerate(fold.held_out):
            np.save(temporary / _PREDICTION.format(number), predict_scan(fitted.model, scan))
        (temporary / _FIT).write_text(record.model_dump_json(indent=1), encoding="utf-8")
