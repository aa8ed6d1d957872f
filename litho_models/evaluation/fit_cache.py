"""Cache the fits of a benchmark. The cache stores the record of each fit and the heights that the fitted
model predicts for the held-out scans.

Each fit (one model on one fold) has its own folder. The name of the folder contains a hash of everything on
which the result of the fit depends.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from litho_data.commands.progress import progress
from litho_data.foundation.files import atomic_folder
from litho_data.foundation.hashes import record_sha256
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_models.fitting import Fitted, TrainingConfig, fit_in_cache
from litho_models.fitting.checkpoint import reading_kept
from litho_models.fitting.fit import FitFacts, common_geometry, run_key
from litho_models.models import build_model
from litho_models.prediction.tiles import predict_scan
from litho_models.scan_terms import BackgroundUse
from litho_models.scan_terms.background import Background, learn_background
from litho_models.scan_terms.measurement import MeasurementModel
from litho_models.scan_terms.measurement_fit import learn_measurement
from litho_models.scoring.metrics import mean_error_nm
from litho_models.scoring.records import Prediction
from litho_models.simulator import Simulator
from litho_models.splits.folds import Fold


class FitDiagnostics(Record):
    """Errors of one fitted model on its training, validation and held-out scans.

    All three are datum-free errors with the policy ``offset`` and without a background, averaged over scans.
    Because they are computed in the same way, differences between them show over-fitting.
    ``inner_validation_nm`` is None if there are no validation scans. ``measurement`` is the measurement model
    that was learned with the fit, or None if there is none.
    """

    background: Background
    measurement: MeasurementModel | None = None
    training_nm: float
    inner_validation_nm: float | None
    held_out_nm: float


_FIT, _PREDICTION = "fit.json", "prediction_{:03d}.npy"


class FitRecord(FitFacts):
    """The record of one fit. It contains the scans, the duration, and the errors, nm, at the training steps
    listed in ``steps``. A validation error is None if there are no validation scans.
    """

    model: str
    fold: int
    key: str
    held_out_ids: list[str]
    steps: list[int]
    training_mae_nm: list[float]
    validation_mae_datum_free_nm: list[float | None]
    diagnostics: FitDiagnostics


def fit_or_load(
    name: str, fold: Fold, config: TrainingConfig, cache: Path, measured: bool
) -> tuple[FitRecord, list[np.ndarray]]:
    """Read a fit from the cache. If it is not there, fit the model now and add it. Return the record of the
    fit and the heights, µm, that it predicts for the held-out scans, as one array of shape (ny, nx) per scan.

    Args:
        measured: also learn a measurement model, i.e. a model of what the microscope adds to the height. It
            is learned from the residuals of a first fit. What it predicts is subtracted from the training
            scans, and the fit is repeated. Then the measurement model is learned again.

    Raises:
        InputError: the cached fit cannot be read.
    """
    untrained = build_model(name, config.variant, **common_geometry(fold.training))
    key = run_key(untrained, fold.training, config, [scan.id for scan in fold.held_out])
    key = record_sha256({"fit": key, "background": "shared"}) if measured else key
    folder = fit_folder(cache, name, key)
    if not (folder / _FIT).exists():
        # A finished training is read from its checkpoint; a small model is fitted again.
        fitted = fit_in_cache(name, fold.training, config, cache)
        if measured:
            fitted = fit_in_cache(name, _freed(fitted.model, fold.training), config, cache)
        _keep_fit(folder, fitted, fold, key, measured)
    return kept_fit(folder)


def _freed(model: Simulator, scans: Sequence[PrintedScan]) -> list[PrintedScan]:
    """Learn a measurement model from the scans and the predictions of ``model``. Return the scans without the
    contribution that the measurement model predicts.
    """
    heights = [predict_scan(model, scan) for scan in scans]
    learned = learn_measurement(scans, heights)
    return [learned.freed(scan, height) for scan, height in zip(scans, heights, strict=True)]


def expected(
    record: FitRecord, background: BackgroundUse, scan: PrintedScan, height_um: np.ndarray
) -> Prediction:
    """Return the predicted scan. With ``training``, the predicted height is combined with the background that
    was learned from the training scans of the fit. With ``shared``, it is combined with the measurement model
    that was learned from them. With ``none``, the prediction contains only the height.
    """
    found = record.diagnostics
    if background == "none":
        return Prediction(height_um)
    if background == "shared" and found.measurement is not None:
        return Prediction.seen(found.measurement, scan, height_um)
    return Prediction.beside(found.background, scan, height_um)


def fit_folder(cache: Path, name: str, key: str) -> Path:
    """Return the folder in which the fit with this key is cached."""
    return cache / f"{name}-{key[:16]}"


def kept_fit(folder: Path) -> tuple[FitRecord, list[np.ndarray]]:
    """Read the record of a fit, and the predicted heights, µm, of the scans in the record's ``held_out_ids``.
    There is one array of shape (ny, nx) per scan.

    Raises:
        InputError: a file is missing or damaged.
    """
    with reading_kept(folder):
        record = FitRecord.model_validate_json((folder / _FIT).read_bytes())
        files = [folder / _PREDICTION.format(number) for number in range(len(record.held_out_ids))]
        return record, [np.load(file, allow_pickle=False) for file in files]


def _keep_fit(folder: Path, fitted: Fitted, fold: Fold, key: str, measured: bool) -> None:
    model, chose = fitted.model, fitted.facts.validation_ids
    held_out = [predict_scan(model, scan) for scan in fold.held_out]
    own = [predict_scan(model, scan) for scan in progress(fold.training, "predicting")]

    def error_nm(chosen_on: bool) -> float:
        pairs = [pair for pair in zip(fold.training, own, strict=True) if (pair[0].id in chose) == chosen_on]
        return mean_error_nm([scan for scan, _ in pairs], [height for _, height in pairs])

    record = FitRecord(
        model=model.name,
        fold=fold.number,
        key=key,
        held_out_ids=[scan.id for scan in fold.held_out],
        steps=[entry.step for entry in fitted.history],
        training_mae_nm=[entry.training_mae_nm for entry in fitted.history],
        validation_mae_datum_free_nm=[entry.validation_mae_datum_free_nm for entry in fitted.history],
        diagnostics=FitDiagnostics(
            background=learn_background(fold.training, own),
            measurement=learn_measurement(fold.training, own) if measured else None,
            training_nm=error_nm(False),
            inner_validation_nm=error_nm(True) if chose else None,
            held_out_nm=mean_error_nm(fold.held_out, held_out),
        ),
        **dict(fitted.facts),
    )
    with atomic_folder(folder) as temporary:
        for number, height in enumerate(held_out):
            np.save(temporary / _PREDICTION.format(number), height)
        (temporary / _FIT).write_text(record.model_dump_json(indent=1), encoding="utf-8")
