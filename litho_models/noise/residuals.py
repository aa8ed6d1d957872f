"""Where residuals come from: a benchmark's cache (out of fold) or frozen models; several make an ensemble."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from litho_data.errors import InputError
from litho_data.store import PrintedScan, Store
from litho_models import zoo
from litho_models.evaluate import predict_frozen, trained_ids
from litho_models.freeze import load_frozen
from litho_models.model_card import CARD_FILE
from litho_models.noise.calibration import Residuals
from litho_models.noise.surface import NM_PER_UM
from litho_models.nuisance import Policy, cross_fitted_residual
from litho_models.splits import locked_ids

Predictions = dict[str, list[np.ndarray]]


def read_residuals(
    store: Store, sources: Sequence[str | Path], model: str | None = None, policy: Policy = "offset"
) -> Residuals:
    """Measured minus the mean prediction of all members, each scan freed of its nuisances by cross-fitting.

    Args:
        store: the store that the sources were made from.
        sources: result folders of ``litho-models benchmark``, whose cache holds predictions of scans that
            the fit never saw, or frozen models (folders, ``zoo:NAME``); not both kinds at once. The lock box
            is left out.
        model: which model of a benchmark; its best one by default.
        policy: nuisances.

    Raises:
        InputError: a folder that is neither, sources of another dataset, or no scan that all predict.
    """
    folders = [zoo.model_folder(source, other="or that of a benchmark") for source in sources]
    frozen = [(folder / CARD_FILE).exists() for folder in folders]
    if any(frozen) and not all(frozen):
        raise InputError("residuals", got="benchmarks and frozen models", wanted="one kind of source")
    if all(frozen):
        name, members, held_out = _of_frozen(store, folders)
    else:
        name, members = _of_benchmarks(store, folders, model)
        held_out = True
    scans = [store.scan(scan_id) for scan_id in store.ids if scan_id in members]
    if not scans:
        raise InputError("residuals", got="no scan of the store", wanted="predictions of its scans")
    count = min(len(members[scan.id]) for scan in scans)
    residuals = []
    for scan in scans:
        mean = np.mean(members[scan.id], axis=0)
        fit = cross_fitted_residual(scan.height_um, mean, scan.valid, policy)
        residuals.append(NM_PER_UM * fit.residual_um)
    spread = [NM_PER_UM * disagreement_um(members[scan.id]) for scan in scans] if count > 1 else None
    return Residuals(name, scans, residuals, spread, count, held_out)


def disagreement_um(predictions_um: Sequence[np.ndarray]) -> np.ndarray:
    """Standard deviation of the members at each pixel, each freed of its own mean: a datum is no knowledge.

    ``(ny, nx)`` µm, with the n − 1 of a sample.
    """
    stack = np.stack([prediction - prediction.mean() for prediction in predictions_um]).astype(np.float64)
    return stack.std(axis=0, ddof=1)


def _of_benchmarks(store: Store, folders: Sequence[Path], model: str | None) -> tuple[str, Predictions]:
    from litho_models.benchmark import Benchmark

    members: Predictions = {}
    chosen = model
    for folder in folders:
        result = Benchmark.read(folder)
        if result.dataset.sha256 != store.sha256:
            raise InputError(
                f"dataset of {folder}", got=result.dataset.name, wanted=f"{store.name}, the store given"
            )
        names = [score.model for score in result.scores]
        chosen = chosen or min(result.scores, key=lambda score: score.mae_datum_free_nm).model
        if chosen not in names:
            raise InputError(f"model of {folder}", got=chosen, wanted=", ".join(names))
        allowed = set(result.split.scored_ids) & set(store.ids)
        for fit in (entry for entry in result.fits if entry.model == chosen):
            for scan_id, prediction in _cached(folder, fit.model, fit.key).items():
                if scan_id in allowed:
                    members.setdefault(scan_id, []).append(prediction)
    return str(chosen), members


def _cached(folder: Path, model: str, key: str) -> dict[str, np.ndarray]:
    cache = folder / "cache" / f"{model}-{key[:16]}"
    record = cache / "fit.json"
    if not record.exists():
        raise InputError(
            f"cache of {folder}", got=f"no {cache.name}", wanted="the benchmark's own cache folder"
        )
    ids = json.loads(record.read_text(encoding="utf-8"))["held_out_ids"]
    files = sorted(cache.glob("prediction_*.npy"))
    return {scan_id: np.load(file, allow_pickle=False) for scan_id, file in zip(ids, files, strict=True)}


def _of_frozen(store: Store, folders: Sequence[Path]) -> tuple[str, Predictions, bool]:
    models = [load_frozen(folder) for folder in folders]
    for frozen in models:
        frozen.check_geometry(store.pitch_um, store.level_height_um)
    trained_on = {scan_id for frozen in models for scan_id in trained_ids(frozen, store)}
    every = store.scans()
    locked = locked_ids(every)
    scans: list[PrintedScan] = [scan for scan in every if scan.id not in locked]
    members = {scan.id: [predict_frozen(frozen, scan) for frozen in models] for scan in scans}
    return "+".join(sorted({frozen.name for frozen in models})), members, not trained_on & set(members)
