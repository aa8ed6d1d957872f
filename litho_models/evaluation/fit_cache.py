"""Cache the fits of a benchmark, each with its predictions of held-out scans, its record and its diagnostics.

Each (model, fold) has its own folder, named by the hash of everything that determines the fit.
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


# Older results have more fields, which are ignored: the cost of a prediction, and its change in another crop.
class FitDiagnostics(Record, extra="ignore"):
    """Errors of one fitted model on its training scans and on held-out scans.

    Each error is the datum-free error of the policy ``offset``, averaged over scans and computed without a
    background. Differences between the three errors therefore show over-fitting. ``inner_validation_nm`` is
    None without validation scans. ``measurement`` is the measurement model learned with the fit, if it was
    removed from the training scans.
    """

    background: Background
    measurement: MeasurementModel | None = None
    training_nm: float
    inner_validation_nm: float | None
    held_out_nm: float


_FIT, _PREDICTION = "fit.json", "prediction_{:03d}.npy"


class FitRecord(FitFacts):
    """The record of one fit: its scans, its cost, and its errors in nm. Validation errors are None without
    validation scans.
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
    """Read a fit from the cache, or fit the model now. Return the record of the fit and the heights (ny, nx),
    µm, that it predicts for the held-out scans.

    Args:
        measured: whether to learn the measurement model from a first fit, subtract it from the training
            scans, repeat the fit, and learn the measurement model again.

    Raises:
        InputError: a cached fit that cannot be read.
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
    """Learn the measurement model from this model's predictions, and remove it from the training scans."""
    heights = [predict_scan(model, scan) for scan in scans]
    learned = learn_measurement(scans, heights)
    return [learned.freed(scan, height) for scan, height in zip(scans, heights, strict=True)]


def expected(
    record: FitRecord, background: BackgroundUse, scan: PrintedScan, height_um: np.ndarray
) -> Prediction:
    """Return the predicted scan: the printed height (ny, nx), µm, combined with the measurement model or the
    background learned from the training scans.
    """
    found = record.diagnostics
    if background == "none":
        return Prediction(height_um)
    if background == "shared" and found.measurement is not None:
        return Prediction.seen(found.measurement, scan, height_um)
    return Prediction.beside(found.background, height_um)


def fit_folder(cache: Path, name: str, key: str) -> Path:
    """Return the folder in which a fit is cached."""
    return cache / f"{name}-{key[:16]}"


def kept_fit(folder: Path) -> tuple[FitRecord, list[np.ndarray]]:
    """Read the record of a fit and the heights (ny, nx), µm, that it predicts for ``held_out_ids``.

    Raises:
        InputError: files that are missing or damaged.
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
