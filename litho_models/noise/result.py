"""The record ``noise.json``. The record contains all results about the noise of a dataset, and the noise
floor that follows from these results.
"""

import numpy as np

from litho_data.foundation.results import Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId
from litho_models.noise.budget import NoiseBudget
from litho_models.noise.calibration import SpreadAnalysis
from litho_models.noise.dose import DoseMatrix
from litho_models.noise.references import ReferencePrints, RepeatedPrints
from litho_models.scoring.noise_floor import UNKNOWN_FLOOR, NoiseFloor
from litho_models.scoring.statistics import rms


class NoiseAnalysis(Result):
    """The content of ``noise.json``."""

    SCHEMA = "litho-models/noise/1"
    FILE_NAME = "noise.json"

    run: RunInfo
    dataset: DatasetId | None
    noise_floor: NoiseFloor
    references: ReferencePrints
    repeats: RepeatedPrints | None = None
    dose: DoseMatrix | None
    budget: NoiseBudget | None = None
    spread: SpreadAnalysis | None
    notes: list[str]


def floor_of(
    found: ReferencePrints, repeats: RepeatedPrints | None, budget: NoiseBudget | None
) -> NoiseFloor:
    """Return the noise floor from the best available source: repeated prints, flat prints, or the residuals
    of a model, in this order of preference.
    """
    if repeats is not None:
        return NoiseFloor(
            mae_nm=repeats.mae_nm,
            rmse_nm=repeats.sigma_nm,
            kind="measured",
            source=f"half the variance of the difference between {repeats.scans} repeated prints, after "
            "offset and bow are removed from each pair",
        )
    flats = [flat for flat in found.flats if flat.background == "offset"]
    if flats:
        return NoiseFloor(
            mae_nm=float(np.mean([one.mae_nm for one in flats])),
            rmse_nm=rms([one.sigma_nm for one in flats]),
            kind="measured",
            source=f"flat print ({', '.join(one.id for one in flats)}), after its offset is removed; it has "
            "only one level, and edges and other levels may be rougher",
        )
    return budget.floor if budget is not None else UNKNOWN_FLOOR
