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
    """One planned scan. ``field_x_um`` and ``field_y_um`` are the position of its print in the write field,
    and ``dose`` is the relative dose of this print. ``print`` is the number of the print, or 0 for scans of a
    reference.
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
    """The predicted comparison of two rivals (competing explanations) on the planned prints.

    ``difference_nm`` is the rms difference between the predictions of the two rivals after one rival has been
    refitted to the prediction of the other. ``noise_nm`` is the standard deviation per pixel of the noise
    after projection onto this difference. ``power`` lists the probabilities of a right decision with 1, 2, 3,
    … prints.
    """

    rivals: tuple[str, str]
    difference_nm: float
    noise_nm: float
    power: list[float]


class PlannedQuestion(Record):
    """An open question, and how the plan answers it.

    ``power`` lists the probabilities of a right decision with 1, 2, 3, … prints. ``random_power`` lists the
    same probabilities for prints with random layouts that are scanned in the same way. ``difference_nm`` is
    the rms difference between the predictions of the two most similar rivals (competing explanations) on the
    planned prints. ``random_difference_nm`` is the corresponding difference on the random layouts.
    ``prints_needed`` is the smallest number of prints with a power of at least 0.95. It is None if even the
    largest number that was tried is too small. ``form_nm`` is an upper bound on the rms error that inexact
    formulas of the model cause, or None if it is unknown.
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
    """A plan: the prints, their scans, and the questions that the prints and scans are meant to decide.

    ``settings`` contains the settings with which the user made the plan. ``levels`` is a pair: the lowest and
    the highest level number that the layouts may contain.
    """

    SCHEMA: ClassVar[str] = "litho-models/next-print/2"
    FILE_NAME: ClassVar[str] = "plan.json"

    run: RunInfo
    dataset: DatasetId
    settings: dict[str, Any]
    prints: int
    field_um: float
    levels: tuple[int, int]
    scans: list[PlannedScan]
    questions: list[PlannedQuestion]
