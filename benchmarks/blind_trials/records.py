"""The files of a campaign: `draws.json` before it, `trial.json` per trial, `scoreboard.json` after it."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator

from litho_data.foundation.results import Record, Result

# The last four since seed 20267.
Kind = Literal["single", "two", "none", "off-catalogue", "in-form", "alias", "other-form", "empty"]
OTHER_FORM: tuple[Kind, ...] = ("off-catalogue", "other-form")
EMPTY: tuple[Kind, ...] = ("none", "empty")
# Causes of a smaller rms are listed and not counted.
COUNTS_FROM_RMS_NM = 8.0
Judgement = Literal[
    "right",
    "set-contains-it",
    "absorbed",
    "partial",
    "wrong",
    "missed",
    "clean",
    "false-positive",
    "traced-to-covariate",
    "unexplained",
    "named-a-cause",
    "failed",
]


class KnobDraw(Record):
    """A knob or a form, and the size that it is to have, see `Planted.rms_nm`."""

    name: str
    wanted_rms_nm: float


class Draw(Record):
    """One trial as drawn.

    ``seed`` decides its layouts, its noise and what its knobs draw; ``printer`` has what differs from the
    fab's default printer.
    """

    number: int
    kind: Kind
    seed: int
    knobs: list[KnobDraw]
    printer: dict[str, float] = Field(default_factory=dict)


class Draws(Result):
    """All trials of a campaign, written before the first of them runs."""

    SCHEMA: ClassVar[str] = "litho-models/blind-trial-draws/1"
    FILE_NAME: ClassVar[str] = "draws.json"

    seed: int
    n_scans: int
    size_px: int
    trials: list[Draw]


class Planted(Record):
    """A knob or a form as it was set.

    Attributes:
        name: of the knob or form; ``effect``: identifier in the effects catalogue, or `off-catalogue`.
        strength: in ``unit``; ``at_limit``: its range ended before the wanted size was reached.
        rms_nm: what base, scan terms and registration, refitted to the noise-free scans, leave. Boards up to
            seed 20266: scans with minus without the knob, freed of {1, P, x, y, x², xy, y²} per scan.
        nuisance_span: True if such terms of single scans absorb nearly all of the effect.
    """

    name: str
    effect: str
    strength: float
    unit: str
    at_limit: bool
    wanted_rms_nm: float
    rms_nm: float
    nuisance_span: bool


class Named(Record):
    """One effect that the loop reports outside the nuisance span, and those that look the same."""

    names: list[str]
    verdict: Literal["explained", "confusable", "partial", "traced-to-covariate"]


class Outcome(Record):
    """What became of one planted effect, or of the whole trial where nothing nameable was planted.

    ``loop_says`` is the loop's own verdict and reason on this effect.
    """

    effect: str
    rms_nm: float
    judgement: Judgement
    loop_says: str


class ErrorPair(Record):
    """Held-out error, nm: mean absolute and root mean square."""

    mae_nm: float
    rmse_nm: float


class TrialErrors(Record):
    """Before, after, and what the true models of print and microscope leave on the same pixels.

    All three with the terms per scan that the loop accepted; on boards before 20267 ``before`` has the zero
    of each scan free only.
    """

    before: ErrorPair
    after: ErrorPair
    floor: ErrorPair

    @property
    def mae_to_floor(self) -> float:
        return self.after.mae_nm / self.floor.mae_nm

    @property
    def rmse_to_floor(self) -> float:
        return self.after.rmse_nm / self.floor.rmse_nm


class Cost(Record):
    """Wall seconds of build and loop; processor seconds of the whole trial, and of build and loop alone.

    The last is None in boards up to seed 20266.
    """

    build_s: float
    loop_s: float
    cpu_s: float
    dataset_cpu_s: float | None = None


class Trial(Result):
    """One trial as it came out; a failed one has a reason and no errors."""

    SCHEMA: ClassVar[str] = "litho-models/blind-trial/1"
    FILE_NAME: ClassVar[str] = "trial.json"

    draw: Draw
    planted: list[Planted]
    outcomes: list[Outcome]
    also_named: list[str]
    named: list[Named]
    scan_terms: list[str]
    verdict: str
    dropped: list[str]
    errors: TrialErrors | None
    cost: Cost | None
    failure: str


class Tally(Record):
    """``count`` of ``total``."""

    count: int
    total: int

    def __str__(self) -> str:
        share = f" ({100 * self.count / self.total:.0f} %)" if self.total else ""
        return f"{self.count} of {self.total}{share}"


class Summary(Record):
    """The figures that the campaign is about; "counted" is what is above ``counts_from_rms_nm``.

    Attributes:
        tolerance_in_form: error after, as a multiple of that of the true models; also for empty trials.
        in_form: right or in the set, of the counted causes in form.
        false_beside: of these, those in trials where a false name stands beside.
        in_form_with_false_name: trials with a cause in form, counted or not, in which a false name was given.
        named, noticed, unnoticed: of the counted causes of another form.
        clean: trials without a cause in which nothing was reported.
        at_floor_in_form: trials in form or empty whose error after is within the tolerance.
        at_floor_other: the same of trials with a cause of another form.
        failed: trials that ended with an error; their causes count as not found and as unnoticed.
        mean_cpu_s, longest_cpu_s: processor seconds of a data set.
    """

    counts_from_rms_nm: float
    tolerance_in_form: float
    tolerance_other: float
    in_form: Tally
    false_beside: Tally
    in_form_with_false_name: Tally
    named: Tally
    noticed: Tally
    unnoticed: Tally
    clean: Tally
    at_floor_in_form: Tally
    at_floor_other: Tally
    failed: int
    mean_cpu_s: float | None
    longest_cpu_s: float | None


class Scoreboard(Result):
    """All trials of a campaign; ``pending`` are drawn but not run.

    The figures of schema 1 (boards up to seed 20266) were others: there ``summary`` is None when read.
    """

    SCHEMA: ClassVar[str] = "litho-models/blind-trials/2"
    OLDER: ClassVar[tuple[str, ...]] = ("litho-models/blind-trials/1",)
    FILE_NAME: ClassVar[str] = "scoreboard.json"

    command: str
    commit: str
    versions: dict[str, str]
    seed: int
    n_scans: int
    size_px: int
    pending: list[int]
    summary: Summary | None
    trials: list[Trial]

    @model_validator(mode="before")
    @classmethod
    def _without_earlier_figures(cls, content: Any) -> Any:
        if isinstance(content, dict) and content.get("schema") in cls.OLDER:
            return content | {"summary": None}
        return content
