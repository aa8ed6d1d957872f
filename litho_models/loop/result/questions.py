"""``open_questions.json``: what a closed loop leaves open, as an experiment can be planned from it."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from litho_data.foundation.results import Record, Result
from litho_data.store.schema import DatasetId
from litho_models.loop.residual_spectrum import NoiseSpectrum

Kind = Literal["set", "suspects", "role", "generic", "per-scan", "lines", "fact"]
Doing = Literal["turned scan", "early print scanned late"]
# What an answer is called whose effect is not whose the catalogue says, or could be either's.
IN_SCAN, IN_PRINT = " as the microscope's", " as the printer's"


def effect_of(answer: str) -> str:
    """The effect that an answer names, whosever it is."""
    return answer.removesuffix(IN_SCAN).removesuffix(IN_PRINT)


class Rival(Record):
    """One answer to a question: the base with these effects, as fitted to the prints so far.

    ``vector``: all fitted numbers, ``loop.parameters.get_vector``; ``information``: (p, p), normal matrix of
    the fit over all pixels that it stands for, µm²; ``covariance``: (p, p) of the numbers, robust over scans,
    empty in older files. ``scan_frame``: effects that turn with the scan; ``print_frame``: effects of the
    microscope that keep to the print.
    """

    name: str
    effects: dict[str, dict[str, float]]
    scan_frame: list[str]
    vector: list[float]
    information: list[list[float]]
    covariance: list[list[float]] = Field(default_factory=list)
    print_frame: list[str] = Field(default_factory=list)


class Turning(Record):
    """A generic term as the printer's and as the microscope's, on layouts like those of the prints so far.

    The two differ where ``by`` is done: by ``rms_nm`` once the scan's own terms are free, and ``noise_nm`` is
    the standard deviation of the noise along that difference, both per scan of ``pixels`` pixels.
    """

    by: Doing
    rms_nm: float
    noise_nm: float
    pixels: int


class Question(Record):
    """Something a loop left open.

    ``spread``: how much the evidence that a print gives for the effect varies between the prints so far,
    relative to its mean, beyond the noise. ``form_nm``: the error of the model's own form at most, rms, by
    what could still be learned beside the best answer; None in files of schema 1. ``sizes``: figures of terms
    of single scans, by name and unit.
    """

    name: str
    kind: Kind
    text: str
    experiment: str
    rivals: list[Rival] = Field(default_factory=list)
    turning: Turning | None = None
    spread: float = 0.0
    form_nm: float | None = None
    sizes: dict[str, float] = Field(default_factory=dict)


class OpenQuestions(Result):
    """``open_questions.json``: what is open, and the noise against which it is to be decided."""

    SCHEMA: ClassVar[str] = "litho-models/open-questions/2"
    OLDER: ClassVar[tuple[str, ...]] = ("litho-models/open-questions/1",)
    FILE_NAME: ClassVar[str] = "open_questions.json"

    dataset: DatasetId
    n_scans: int
    field_px: tuple[int, int]
    noise: NoiseSpectrum
    level_share: list[float]
    power_share: list[float]
    frequency_per_um: list[float]
    write_field_um: float | None
    questions: list[Question]
