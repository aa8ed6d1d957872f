"""``noise.json``: everything known about the noise of a dataset, and the floor that follows."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunInfo
from litho_models.frozen.card import DatasetName
from litho_models.noise.bounds import NoiseBound
from litho_models.noise.calibration import SpreadAnalysis
from litho_models.noise.dose import DoseMatrix
from litho_models.noise.staircase import StepPrint
from litho_models.noise.surface import PrintNoise, SurfaceNoise
from litho_models.scoring.noise_floor import NoiseFloor


class ReferencePrints(Record):
    """Scans made to measure the noise: bare substrate, flat print, step print."""

    substrates: list[SurfaceNoise] = Field(default_factory=list)
    flats: list[SurfaceNoise] = Field(default_factory=list)
    print_noise: list[PrintNoise] = Field(default_factory=list)
    steps: list[StepPrint] = Field(default_factory=list)


class NoiseAnalysis(Result):
    """``noise.json``."""

    SCHEMA: ClassVar[str] = "litho-models/noise/1"
    FILE_NAME: ClassVar[str] = "noise.json"

    schema_: Literal["litho-models/noise/1"] = Field("litho-models/noise/1", alias="schema")
    run: RunInfo
    dataset: DatasetName | None
    noise_floor: NoiseFloor
    references: ReferencePrints
    dose: DoseMatrix | None
    bounds: list[NoiseBound]
    spread: SpreadAnalysis | None
    notes: list[str]
