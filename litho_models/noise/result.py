"""``noise.json``: everything known about the noise of a dataset, and the floor that follows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

from pydantic import Field

from litho_data.foundation.results import Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId
from litho_models.noise.bounds import NoiseBound
from litho_models.noise.calibration import SpreadAnalysis
from litho_models.noise.dose import DoseMatrix
from litho_models.noise.references import ReferencePrints
from litho_models.noise.surface import pooled
from litho_models.scoring.noise_floor import NoiseFloor


class NoiseAnalysis(Result):
    """``noise.json``."""

    SCHEMA: ClassVar[str] = "litho-models/noise/1"
    FILE_NAME: ClassVar[str] = "noise.json"

    schema_: Literal["litho-models/noise/1"] = Field("litho-models/noise/1", alias="schema")
    run: RunInfo
    dataset: DatasetId | None
    noise_floor: NoiseFloor
    references: ReferencePrints
    dose: DoseMatrix | None
    bounds: list[NoiseBound]
    spread: SpreadAnalysis | None
    notes: list[str]


def floor_of(found: ReferencePrints, bounds: Sequence[NoiseBound]) -> NoiseFloor:
    """The floor for ``mae_datum_free`` with policy ``offset``: repeats, a flat print, or a lower bound."""
    for bound in bounds:
        if bound.name.startswith("repeated prints"):
            return NoiseFloor(
                mae_nm=bound.mae_nm,
                rmse_nm=bound.sigma_nm,
                kind="measured",
                source=f"{bound.name}; contains {bound.contains}; lacks {bound.lacks}",
            )
    flats = [flat for flat in found.flats if flat.background == "offset"]
    if flats:
        flat = pooled(flats)
        return NoiseFloor(
            mae_nm=flat.mae_nm,
            rmse_nm=flat.sigma_nm,
            kind="measured",
            source=f"flat print ({', '.join(one.id for one in flats)}), offset removed, MAE as measured; one "
            "level only: edges and other levels may be rougher",
        )
    lower = [bound for bound in bounds if bound.of == "all" and bound.direction == "lower bound"]
    if lower:
        best = max(lower, key=lambda bound: bound.sigma_nm)
        return NoiseFloor(
            mae_nm=best.mae_nm,
            rmse_nm=best.sigma_nm,
            kind="lower-bound",
            source=f"{best.name}; contains {best.contains}; lacks {best.lacks}",
        )
    return NoiseFloor(mae_nm=None, rmse_nm=None, kind="unknown", source="nothing measured that bounds it")
