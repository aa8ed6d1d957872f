"""The noise floor of a dataset: the error that roughness and microscope alone would leave."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import ConfigDict

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record, Result
from litho_data.store.schema import DatasetId

NOISE_FILE = "noise.json"
_PAPER_DATASET = "neural-lithography"


class NoiseFloor(Record):
    """The error that roughness and microscope alone would leave; ``kind`` says how it is known."""

    mae_nm: float | None
    rmse_nm: float | None
    kind: Literal["measured", "lower-bound", "literature", "unknown"]
    source: str


class _StatedFloor(Result):
    """What is read of a noise analysis here: whose it is, and the floor."""

    model_config = ConfigDict(extra="ignore")

    SCHEMA: ClassVar[str] = "litho-models/noise/1"
    FILE_NAME: ClassVar[str] = NOISE_FILE

    dataset: DatasetId | None
    noise_floor: NoiseFloor


def noise_floor(dataset_name: str, analysis: str | Path | None = None) -> NoiseFloor:
    """What is known about the floor of a dataset: from its noise analysis, else from the literature.

    Args:
        dataset_name: name of the dataset whose errors are reported.
        analysis: ``noise.json``, or its folder, of this dataset or of scans without one.

    Raises:
        InputError: no noise analysis there, or one of another dataset.
    """
    if analysis is not None:
        found = _StatedFloor.read(analysis)
        if found.dataset is not None and found.dataset.name != dataset_name:
            raise InputError(f"noise analysis {analysis}", got=found.dataset.name, wanted=dataset_name)
        return found.noise_floor
    if dataset_name == _PAPER_DATASET:
        # 0.798 σ is the mean absolute value of a Gaussian of standard deviation σ.
        return NoiseFloor(
            mae_nm=12.7,
            rmse_nm=15.96,
            kind="literature",
            source="roughness of the paper's flat print (arXiv:2309.17343); MAE 0.798 σ if Gaussian; "
            "its band and levelling are not those of these scans",
        )
    return NoiseFloor(
        mae_nm=None, rmse_nm=None, kind="unknown", source="no flat or repeated print in the store"
    )
