"""All models on one dataset under one protocol: trained per fold, scored on scans never seen.

Each (model, fold) is a folder of its own in the cache, named by the hash of everything that decides
it; a benchmark that was stopped continues where it was, and an unchanged fit is never repeated.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from litho_data.commands import progress
from litho_data.files import atomic_file, atomic_folder
from litho_data.results import Record, Result
from litho_data.store import PrintedScan, open_store
from litho_models.background import BackgroundUse
from litho_models.benchmark_report import write_benchmark_report
from litho_models.diagnostics import FitDiagnostics, diagnose
from litho_models.evaluate import SplitRecord
from litho_models.folds import GROUPED_FOLDS, Fold, SplitKind, plan_folds
from litho_models.metrics import paired_difference
from litho_models.model_card import DatasetName
from litho_models.models import build_model, model_class
from litho_models.nuisance import Policy
from litho_models.run_info import RunInfo, run_info
from litho_models.runs import training_config
from litho_models.score_records import ModelScores, NuisanceProtocol, Prediction
from litho_models.scores import NoiseFloor, noise_floor, protocol_for, score_model
from litho_models.splits import ids_sha256, locked_ids
from litho_models.tiles import predict_scan
from litho_models.training import Fitted, TrainingConfig, fit_in_cache
from litho_models.training.fit import common_geometry, run_key

BASELINES = ("identity", "affine", "affine-mtf", "blur-table", "linear")
DEFAULT_MODELS = (*BASELINES, "physics", "pbl", "fno")


class FitRecord(Record):
    """One fit: what it saw and what it cost; errors are nm, None where the model has no rounds.

    ``diagnostics`` are None in results of before they were made.
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
    diagnostics: FitDiagnostics | None = None


class Paired(Record):
    """Mean over scans of first minus second ``mae_datum_free_nm``; negative means the first is better."""

    first: str
    second: str
    mean_nm: float
    ci95_nm: tuple[float, float] | None
    p: float
    first_better: int
    scans: int


class Benchmark(Result):
    """``benchmark.json``."""

    SCHEMA: ClassVar[str] = "litho-models/benchmark/1"
    FILE_NAME: ClassVar[str] = "benchmark.json"

    schema_: Literal["litho-models/benchmark/1"] = Field("litho-models/benchmark/1", alias="schema")
    run: RunInfo
    dataset: DatasetName
    split: SplitRecord
    nuisance: NuisanceProtocol
    noise_floor: NoiseFloor
    training: dict[str, dict[str, Any]]
    scores: list[ModelScores]
    locked_scores: list[ModelScores] = Field(default_factory=list)
    paired: list[Paired]
    fits: list[FitRecord]


def benchmark(
    store: str | Path,
    out: str | Path,
    *,
    split: SplitKind = "grouped",
    models: Sequence[str] = DEFAULT_MODELS,
    settings: dict[str, Any] | None = None,
    folds: int = GROUPED_FOLDS,
    policy: Policy = "offset",
    background: BackgroundUse = "training",
    noise: str | Path | None = None,
    open_lock_box: bool = False,
    seed: int = 0,
) -> Benchmark:
    """Train and score ``models`` out of fold; write ``benchmark.json``, a report and CSV tables.

    Args:
        store: dataset store.
        out: result folder; ``out/cache`` keeps every fit.
        split: ``grouped`` by scan, ``leave-one-print-out``, or ``paper``: one random 75/25 draw of
            quadrants over all scans, leaky, for comparison with the paper only.
        models: names of models; baselines cost next to nothing and belong in the table.
        settings: fields of ``TrainingConfig`` that replace the recipe's.
        folds: number of folds of ``grouped``, at most the number of development scans.
        policy: nuisances of ``mae_datum_free_nm``.
        background: whether each fit's background, learned on its training scans, is added to its predictions.
        noise: ``noise.json`` of this dataset, or its folder: the floor beside the errors is the one in it.
        open_lock_box: also train on all development scans and score the locked ones.
        seed: of the split, the nuisance blocks and the training.

    Raises:
        InputError: unknown model, a store that cannot be read or is too small for the split, or a noise
            analysis of other data.
    """
    for name in models:
        model_class(name)
    dataset = open_store(store)
    scans = dataset.scans()
    floor = noise_floor(dataset.name, noise)
    locked = locked_ids(scans)
    plan = plan_folds(scans, locked, split, folds=folds, seed=seed, open_lock_box=open_lock_box)
    configs = {name: _config(name, settings, seed) for name in models}
    fits: list[FitRecord] = []
    predicted: dict[tuple[str, bool], dict[str, Prediction]] = {}
    jobs = [(name, fold) for name in models for fold in plan]
    for name, fold in progress(jobs, f"benchmark of {dataset.name}"):
        record, predictions = _fit_or_load(name, fold, configs[name], Path(out) / "cache", background)
        fits.append(record)
        predicted.setdefault((name, fold.locked), {}).update(predictions)
    protocol = protocol_for(policy, seed, background)
    scored = [scan for fold in plan if not fold.locked for scan in fold.held_out]
    boxed = [scan for fold in plan if fold.locked for scan in fold.held_out]

    def score(name: str, judged: Sequence[PrintedScan], locked: bool) -> ModelScores:
        own = predicted[name, locked]
        return score_model(name, judged, [own[scan.id] for scan in judged], protocol)

    scores = [score(name, scored, False) for name in models]
    ids = [scan.id for scan in scored]
    result = Benchmark(
        schema="litho-models/benchmark/1",
        run=run_info([seed], len(scans)),
        dataset=DatasetName(name=dataset.name, sha256=dataset.sha256),
        split=SplitRecord(
            kind=split,
            folds=sum(not fold.locked for fold in plan),
            seed=seed,
            scored_ids=ids,
            scored_ids_sha256=ids_sha256(ids),
            lock_box=locked,
            lock_box_opened=open_lock_box or split == "paper",
        ),
        nuisance=protocol,
        noise_floor=floor,
        training={name: config.model_dump(mode="json") for name, config in configs.items()},
        scores=scores,
        locked_scores=[score(name, boxed, True) for name in models] if boxed else [],
        paired=_all_pairs(scores, seed),
        fits=fits,
    )
    result.write(out)
    maps = {name: {scan.id: predicted[name, False][scan.id].map_um for scan in scored} for name in models}
    write_benchmark_report(result, scored, maps, out)
    return result


def _config(name: str, settings: dict[str, Any] | None, seed: int) -> TrainingConfig:
    given = {"seed": seed, **(settings or {})}
    return training_config(given.pop("recipe", "fast"), name, given)


def _fit_or_load(
    name: str, fold: Fold, config: TrainingConfig, cache: Path, background: BackgroundUse
) -> tuple[FitRecord, dict[str, Prediction]]:
    untrained = build_model(name, config.variant, **common_geometry(fold.training))
    key = run_key(untrained, fold.training, config, [scan.id for scan in fold.held_out])
    folder = cache / f"{name}-{key[:16]}"
    fit_file, diagnostics_file = folder / "fit.json", folder / "diagnostics.json"
    if not (fit_file.exists() and diagnostics_file.exists()):
        # A finished training is read from its checkpoint; a small model is fitted again.
        fitted = fit_in_cache(name, fold.training, config, cache)
        if not fit_file.exists():
            _keep_fit(folder, fitted, fold, key)
        heights = _kept_heights(folder)
        found = diagnose(fitted.model, fold.training, fitted.validation_ids, fold.held_out, heights)
        with atomic_file(diagnostics_file) as temporary:
            temporary.write_text(found.model_dump_json(indent=1), encoding="utf-8")
    record = FitRecord.model_validate_json(fit_file.read_text(encoding="utf-8"))
    diagnostics = FitDiagnostics.model_validate_json(diagnostics_file.read_text(encoding="utf-8"))
    learned = diagnostics.background if background == "training" else None
    predictions = {
        scan.id: Prediction(height, learned.map_um(scan.shape) if learned else None)
        for scan, height in zip(fold.held_out, _kept_heights(folder), strict=True)
    }
    return record.model_copy(update={"diagnostics": diagnostics}), predictions


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
        training_mae_nm=[entry.training_mae_nm for entry in fitted.history],
        validation_mae_datum_free_nm=[entry.validation_mae_datum_free_nm for entry in fitted.history],
    )
    with atomic_folder(folder) as temporary:
        for number, scan in enumerate(fold.held_out):
            np.save(temporary / f"prediction_{number:03d}.npy", predict_scan(fitted.model, scan))
        (temporary / "fit.json").write_text(record.model_dump_json(indent=1), encoding="utf-8")


def _kept_heights(folder: Path) -> list[np.ndarray]:
    return [np.load(file, allow_pickle=False) for file in sorted(folder.glob("prediction_*.npy"))]


def _all_pairs(scores: Sequence[ModelScores], seed: int) -> list[Paired]:
    pairs = []
    for position, first in enumerate(scores):
        for second in scores[position + 1 :]:
            compared = paired_difference(
                [row.mae_datum_free_nm for row in first.scans],
                [row.mae_datum_free_nm for row in second.scans],
                seed=seed,
            )
            pairs.append(
                Paired(
                    first=first.model,
                    second=second.model,
                    mean_nm=compared.mean,
                    ci95_nm=compared.interval if compared.scans > 1 else None,
                    p=compared.p,
                    first_better=compared.first_better,
                    scans=compared.scans,
                )
            )
    return pairs
