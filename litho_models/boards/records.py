"""The files of a board: draws, what they hide, the answer of a loop, each trial as judged, the scoreboard."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from litho_data.foundation.results import Record, Result

Board = Literal["singles", "mixtures"]
Kind = Literal["in-form", "alias", "other-form", "empty", "mixture", "measured"]
# Causes of a smaller rms are listed but not counted.
COUNTS_FROM_RMS_NM = 8.0
Verdict = Literal[
    "right",
    "set-contains-it",
    "lawful",
    "noticed",
    "absorbed",
    "missed",
    "clean",
    "false-positive",
    "failed",
]


class CauseDraw(Record):
    """A knob or a form, and its wanted size, see `Planted.rms_nm`.

    Attributes:
        by: ``batch``: scans after ``place`` in the printing order have ``weak`` times the strength;
            ``field``: scans whose id ends in none of the digits of ``place`` have it.
    """

    name: str
    wanted_rms_nm: float
    by: Literal["all", "batch", "field"] = "all"
    place: str = ""
    weak: float = 1.0


class Draw(Record):
    """One trial as drawn.

    Attributes:
        seed: decides its layouts, its noise and what its knobs draw.
        printer: what differs from the default printer; ``base``: a form that no Physics model has.
    """

    number: int
    kind: Kind
    seed: int
    causes: list[CauseDraw]
    printer: dict[str, float] = Field(default_factory=dict)
    base: CauseDraw | None = None


class Draws(Result):
    """All trials of a board, written before any of them runs; ``base``: the model that loops correct."""

    SCHEMA: ClassVar[str] = "litho-models/blind-trial-draws/2"
    FILE_NAME: ClassVar[str] = "draws.json"

    board: Board
    seed: int
    n_scans: int
    size_px: int
    base: str
    trials: list[Draw]


class Planted(Record):
    """A knob or a form as it was set.

    Attributes:
        names: names in the effects catalogue that are right for it.
        strength: in ``unit``; ``at_limit``: its range ended before the wanted size was reached.
        rms_nm: rms that it alone leaves after a refit of base, scan terms and registration without noise.
    """

    draw: CauseDraw
    names: list[str]
    strength: float
    unit: str
    at_limit: bool
    rms_nm: float

    @property
    def counts(self) -> bool:
        return self.rms_nm > COUNTS_FROM_RMS_NM


class Hidden(Result):
    """What one store of a board hides; the loop does not see this file."""

    SCHEMA: ClassVar[str] = "litho-models/board-hidden/1"
    FILE_NAME: ClassVar[str] = "hidden.json"

    planted: list[Planted]


class Outcome(Record):
    """What became of one planted cause, or of the whole trial where nothing was planted."""

    name: str
    verdict: Verdict


class TrialErrors(Record):
    """Mean absolute error on held-out scans, k = 1: of the base, with all that was found, of the true models.

    For measured prints the true models are unknown.
    """

    before_nm: float
    after_nm: float
    floor_nm: float | None

    @property
    def ratio(self) -> float | None:
        """Ratio of the error with all that was found to that of the true models."""
        return self.after_nm / self.floor_nm if self.floor_nm else None


class Found(Record):
    """One thing that a loop reports.

    Attributes:
        names: its name in the catalogue, then those of effects that look the same.
        by: grouping by which its strength differs; ``scan``: one strength per scan; ``all``: one for all.
        exponents: intervals of its exponent, where it is a power law.
    """

    names: list[str]
    knowledge: Literal["cause", "law", "description"]
    by: str = "all"
    exponents: list[tuple[float, float]] = Field(default_factory=list)


class Answer(Result):
    """What a loop says about one store.

    Attributes:
        found: causes, laws and descriptions.
        left: whether something is left that it cannot explain.
        absorbed: names of effects that its base absorbs.
        displaced_by: groupings of scans that share a displacement along x, each as in `Found.by`.
        before_nm, after_nm: mean absolute error without and with what was found, over the scans that are not
            locked, each by a fit that has not seen it, one offset per scan free. None: not stated.
        base_values, corrected_values: values of the Physics model, without and with what was found.
    """

    SCHEMA: ClassVar[str] = "litho-models/board-answer/1"
    FILE_NAME: ClassVar[str] = "answer.json"

    found: list[Found] = Field(default_factory=list)
    left: bool = False
    absorbed: list[str] = Field(default_factory=list)
    displaced_by: list[str] = Field(default_factory=list)
    before_nm: float | None = None
    after_nm: float | None = None
    base_values: dict[str, float] = Field(default_factory=dict)
    corrected_values: dict[str, float] = Field(default_factory=dict)


class Trial(Result):
    """The result of one trial; a failed one has a reason and no errors.

    Attributes:
        false_names: sets of causes that the loop named although nothing in them was planted.
        bias: median of the relative errors of the base's values, without and with what was found; None where
            the printer is no Physics model, or the loop chose another base.
        dataset_cpu_s: processor seconds of build and loop.
    """

    SCHEMA: ClassVar[str] = "litho-models/blind-trial/2"
    FILE_NAME: ClassVar[str] = "trial.json"

    draw: Draw
    planted: list[Planted]
    outcomes: list[Outcome]
    false_names: list[str] = Field(default_factory=list)
    found: list[Found] = Field(default_factory=list)
    verdict: str = ""
    base_model: str = ""
    errors: TrialErrors | None = None
    bias: tuple[float, float] | None = None
    dataset_cpu_s: float | None = None
    failure: str = ""


class Scoreboard(Result):
    """All trials of a board; ``pending`` are drawn but not run; ``command`` makes the scoreboard again."""

    SCHEMA: ClassVar[str] = "litho-models/blind-trials/3"
    FILE_NAME: ClassVar[str] = "scoreboard.json"

    command: str
    commit: str
    versions: dict[str, str]
    board: Board
    seed: int
    pending: list[int]
    trials: list[Trial]
