"""The results of this room: ``evaluation.json`` of one frozen model, ``benchmark.json`` of many fits."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId
from litho_models.evaluation.diagnostics import TileConsistency
from litho_models.evaluation.fit_cache import FitRecord
from litho_models.prediction.cost import PredictionCost
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.noise_floor import NoiseFloor
from litho_models.scoring.pairs import Paired
from litho_models.scoring.records import ModelScores
from litho_models.splits.folds import ScoredSplit


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

    run: RunInfo
    dataset: DatasetId
    model: ModelRecord
    split: ScoredSplit
    nuisance: NuisanceProtocol
    noise_floor: NoiseFloor
    trained_on_scored_scans: list[str]
    scores: ModelScores


class Benchmark(Result):
    """``benchmark.json``."""

    SCHEMA: ClassVar[str] = "litho-models/benchmark/1"
    FILE_NAME: ClassVar[str] = "benchmark.json"

    run: RunInfo
    dataset: DatasetId
    split: ScoredSplit
    nuisance: NuisanceProtocol
    noise_floor: NoiseFloor
    training: dict[str, dict[str, Any]]
    scores: list[ModelScores]
    locked_scores: list[ModelScores] = Field(default_factory=list)
    paired: list[Paired]
    fits: list[FitRecord]
