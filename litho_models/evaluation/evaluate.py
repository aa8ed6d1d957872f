"""One frozen model on a dataset: ``evaluation.json`` and a report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record, Result
from litho_data.store import PrintedScan, Store, open_store
from litho_data.store.lock_box import ids_sha256
from litho_models.evaluation.diagnostics import TileConsistency, device_of, tile_consistency
from litho_models.evaluation.evaluation_report import write_evaluation_report
from litho_models.frozen import zoo
from litho_models.frozen.card import DatasetName
from litho_models.frozen.files import load_frozen
from litho_models.frozen.simulator import FrozenSimulator
from litho_models.prediction.cost import PredictionCost, measured_predictions
from litho_models.run_info import RunInfo, run_info
from litho_models.scan_terms.background import Background, BackgroundUse
from litho_models.scan_terms.nuisance import Policy
from litho_models.scoring.noise_floor import NoiseFloor, noise_floor
from litho_models.scoring.records import ModelScores, NuisanceProtocol, Prediction
from litho_models.scoring.scores import protocol_for, score_model


class SplitRecord(Record):
    """Which scans were scored, and how that set came about.

    ``lock_box``: the locked scans of the dataset, scored or not; ``lock_box_opened``: whether any was scored.
    """

    kind: str
    folds: int = 0
    seed: int = 0
    scored_ids: list[str]
    scored_ids_sha256: str
    lock_box: list[str] = Field(default_factory=list)
    lock_box_opened: bool = False


class ModelRecord(Record):
    """The frozen model that was scored, and what its predictions cost."""

    name: str
    sha256: str
    extrapolated: bool
    parameters: int | None = None
    tiles: TileConsistency | None = None
    cost: PredictionCost | None = None


class Evaluation(Result):
    """``evaluation.json``."""

    SCHEMA: ClassVar[str] = "litho-models/evaluation/1"
    FILE_NAME: ClassVar[str] = "evaluation.json"

    schema_: Literal["litho-models/evaluation/1"] = Field("litho-models/evaluation/1", alias="schema")
    run: RunInfo
    dataset: DatasetName
    model: ModelRecord
    split: SplitRecord
    nuisance: NuisanceProtocol
    noise_floor: NoiseFloor
    trained_on_scored_scans: list[str]
    scores: ModelScores


def evaluate(
    model: str | Path,
    store: str | Path,
    out: str | Path,
    *,
    policy: Policy = "offset",
    background: BackgroundUse = "training",
    noise: str | Path | None = None,
    scan_ids: Sequence[str] | None = None,
    extrapolate: bool = False,
    open_lock_box: bool = False,
    device: str = "cpu",
) -> Evaluation:
    """Score a frozen model on the scans of a store and write the result and its report.

    The locked scans are kept for models of these prints: one that was trained on them, in this store or in
    another one built from the same raw files, is not scored on the locked ones unless asked for. Locked are
    those of this store and those that were when the model was made. A model of other prints is scored on
    all scans. The result says which were locked, and whether any was scored.

    Args:
        model: folder of a frozen model, or ``zoo:NAME``.
        store: dataset store.
        out: folder for ``evaluation.json``, ``report.html`` and the CSV tables.
        policy: nuisances that a scan may be freed of.
        background: whether the background in the model's card is added to the predictions; a card without
            one, or with one of fields of another size, adds none, and the result says so.
        noise: ``noise.json`` of this dataset, or its folder: the floor beside the errors is the one in it.
        scan_ids: exactly these scans, locked ones among them too.
        extrapolate: accept layouts beyond the model's calibrated range.
        open_lock_box: score the locked scans also of the prints that the model was trained on.

    Raises:
        InputError: a model or store that cannot be read, geometries that differ, or a noise analysis of
            other data.
    """
    dataset = open_store(store)
    floor = noise_floor(dataset.name, noise)
    frozen = load_frozen(zoo.model_folder(model), device=device, extrapolate=extrapolate)
    frozen.check_geometry(dataset.pitch_um, dataset.level_height_um)
    every = dataset.scans()
    kept = _locked_by_the_card(frozen, dataset)
    locked = sorted({*dataset.locked_ids, *kept})
    if scan_ids is not None:
        scans = [dataset.scan(scan_id) for scan_id in scan_ids]
    else:
        own = _of_these_prints(frozen, dataset)
        scans = [scan for scan in every if open_lock_box or not own or scan.id not in locked]
    if not scans:
        raise InputError(f"scans of {store}", got="none", wanted="at least one to score")
    ids = [scan.id for scan in scans]
    learned = card_background(frozen, scans) if background == "training" else None
    heights, cost = measured_predictions(lambda scan: predict_frozen(frozen, scan), scans, device_of(frozen))
    predictions = [Prediction.beside(learned, height) for height in heights]
    protocol = protocol_for(policy, background="training" if learned else "none")
    result = Evaluation(
        schema="litho-models/evaluation/1",
        run=run_info([protocol.seed], len(scans)),
        dataset=DatasetName(name=dataset.name, sha256=dataset.sha256),
        model=ModelRecord(
            name=frozen.name,
            sha256=frozen.sha256,
            extrapolated=extrapolate,
            parameters=frozen.card["parameters"],
            tiles=tile_consistency(frozen.simulator, scans[0]),
            cost=cost,
        ),
        split=SplitRecord(
            kind="given",
            scored_ids=ids,
            scored_ids_sha256=ids_sha256(ids),
            lock_box=locked,
            lock_box_opened=not set(locked).isdisjoint(ids),
        ),
        nuisance=protocol,
        noise_floor=floor,
        trained_on_scored_scans=sorted(trained_ids(frozen, dataset) & set(ids)),
        scores=score_model(frozen.name, scans, predictions, protocol),
    )
    result.write(out)
    write_evaluation_report(result, scans, [prediction.map_um for prediction in predictions], out)
    return result


def trained_ids(model: FrozenSimulator, dataset: Store) -> set[str]:
    """The scans that the model was trained on, none where it was made of other prints than the store's."""
    return set(model.card["training"].get("scan_ids", [])) if _of_these_prints(model, dataset) else set()


def _of_these_prints(model: FrozenSimulator, dataset: Store) -> bool:
    """Whether a model was made of the prints in a store: the same dataset, or the same locked scans in it."""
    same_dataset = (model.card["dataset"] or {}).get("sha256") == dataset.sha256
    return same_dataset or bool(_locked_by_the_card(model, dataset))


def _locked_by_the_card(model: FrozenSimulator, dataset: Store) -> list[str]:
    """The scans of a store that were locked when the model was made, by their raw files.

    Another recipe or registration changes every height of a store, a scan more or less the box that it
    draws, but neither changes a raw file. A card that lists no files locks the ids of its box in a dataset of
    the same name.
    """
    split = model.card["split"]
    if files := split.get("lock_box_files_sha256"):
        return [scan_id for scan_id, file in dataset.files_sha256(dataset.ids).items() if file in files]
    same_name = (model.card["dataset"] or {}).get("name") == dataset.name
    return [scan_id for scan_id in split.get("lock_box", []) if same_name and scan_id in dataset.ids]


def card_background(model: FrozenSimulator, scans: Sequence[PrintedScan]) -> Background | None:
    """The background in a model's card, if it has one and the scans are of the size it was learned on."""
    stated = model.card["background"]
    learned = Background.model_validate(stated) if stated is not None else None
    return learned if learned is not None and all(learned.fits(scan) for scan in scans) else None


def predict_frozen(model: FrozenSimulator, scan: PrintedScan) -> np.ndarray:
    """Height that a frozen model expects for a scan, float32 (ny, nx) µm."""
    device = next((p.device for p in model.parameters()), torch.device("cpu"))
    with torch.no_grad():
        layout = torch.from_numpy(scan.layout_um)[None, None].to(device)
        return model(layout, pitch_um=scan.pitch_um, level_height_um=scan.level_height_um)[0, 0].cpu().numpy()
