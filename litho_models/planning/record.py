"""The record of a plan, ``plan.json`` (schema ``litho-models/next-print/2``)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from litho_data.cards.card import Use
from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId

Status = Literal["decides", "may decide", "no experiment separates", "needs a fact"]


class PlannedScan(Record):
    """One planned scan. ``field_x_um`` and ``field_y_um`` are the position of the scan in the write field,
    and ``dose`` is the dose of the print.
    """

    id: str
    print: str
    order: int
    use: Use
    turned_deg: int
    direction: int
    tip: int
    pixel_size: float
    field_x_um: float
    field_y_um: float
    dose: float
    why: str


class PlannedPair(Record):
    """Two rivals.

    ``difference_nm`` is the rms difference between their refitted predictions on the planned prints, and
    ``noise_nm`` is the rms noise of this difference.
    """

    rivals: tuple[str, str]
    difference_nm: float
    noise_nm: float
    power: list[float]


class PlannedQuestion(Record):
    """An open question and how the plan answers it.

    ``power`` is the probability of a right decision with 1, 2, 3, … prints. ``random_power`` is the same
    probability for random layouts that are scanned in the same way. ``random_difference_nm`` is the
    difference between the two most similar rivals on these random layouts. ``prints_needed`` is the number of
    prints for a power of 0.95. ``form_nm`` is an upper bound on the error of the model's form, or None if
    unknown.
    """

    name: str
    kind: str
    text: str
    status: Status
    why: str
    rivals: list[str] = Field(default_factory=list)
    pairs: list[PlannedPair] = Field(default_factory=list)
    difference_nm: float | None = None
    random_difference_nm: float | None = None
    noise_nm: float | None = None
    form_nm: float | None
    power: list[float]
    random_power: list[float]
    prints_needed: int | None
    outcomes: list[str]


class NextPrint(Result):
    """A plan, which contains the prints, the scans, and the questions that the prints and scans decide.

    ``settings`` contains the settings that the user gave.
    """

    SCHEMA: ClassVar[str] = "litho-models/next-print/2"
    FILE_NAME: ClassVar[str] = "plan.json"
    FORMER: ClassVar[frozenset[str]] = frozenset({"smallest_feature_um", "level_distance", "starts"})

    run: RunInfo
    dataset: DatasetId
    settings: dict[str, Any]
    prints: int
    field_um: float
    levels: tuple[int, int]
    cutoff_per_um: float
    scans: list[PlannedScan]
    questions: list[PlannedQuestion]
