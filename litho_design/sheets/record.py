"""The records of a sheet: ``sheet.json`` describes the sheet, and ``read.json`` its evaluation."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunFacts
from litho_data.store.schema import DatasetId

Arm = Literal["without", "with"]
# Names of the two designs of the hologram. The first is made without a model (for a perfect printer), the
# second with the model.
ARMS: tuple[Arm, ...] = ("without", "with")
HOLOGRAM, SCANS_OF_HOLOGRAMS = "hologram", "hologram-scans"


class Field(Record):
    """One field of a sheet: its number in the order of printing, its file and its purpose."""

    order: int
    id: str
    file: str
    what: str


class Sheet(RunFacts, Result):
    """A sheet of fields that a lab prints and scans.

    ``expected_db`` is the SI-PSNR that the model predicts for the image of each hologram.
    """

    SCHEMA: ClassVar[str] = "litho-design/sheet/1"
    FILE_NAME: ClassVar[str] = "sheet.json"

    settings: dict[str, Any]
    side_um: float
    level_height_um: float
    levels: int
    fields: list[Field]
    expected_db: dict[Arm, float]


class ReadSheet(RunFacts, Result):
    """The evaluation of a sheet's scans.

    Attributes:
        model_nm: mean absolute error, on the new prints, of the model used for the design.
        own_nm: cross-validated mean absolute error of the base model that the correction loop fitted to the
            new prints.
        corrected_nm: cross-validated mean absolute error of the base model together with the effects that the
            loop found.
        found: names of the effects that the loop added.
        verdict: verdict of the loop.
        measured_db: SI-PSNR of the image of each hologram, computed from its measured print.
        expected_db: SI-PSNR of the image of each hologram as predicted when it was designed.
    """

    SCHEMA: ClassVar[str] = "litho-design/sheet-read/1"
    FILE_NAME: ClassVar[str] = "read.json"

    sheet_sha256: str
    dataset: DatasetId
    model: str
    model_nm: float
    own_nm: float
    corrected_nm: float
    found: list[str]
    verdict: str
    measured_db: dict[Arm, float]
    expected_db: dict[Arm, float]
