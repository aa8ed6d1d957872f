"""The files of a campaign: `draws.json` before it, `trial.json` per trial, `scoreboard.json` after it."""

from __future__ import annotations

from typing import ClassVar, Literal

from litho_data.foundation.results import Record, Result

Kind = Literal["single", "two", "none", "off-catalogue"]
Judgement = Literal[
    "right",
    "set-contains-it",
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
    """A knob and the size that its effect is to have; free of nuisances, see `Planted.rms_nm`."""

    name: str
    wanted_rms_nm: float


class Draw(Record):
    """One trial as drawn. ``seed`` decides its layouts, its noise and what its knobs draw."""

    number: int
    kind: Kind
    seed: int
    knobs: list[KnobDraw]


class Draws(Result):
    """All trials of a campaign, written before the first of them runs."""

    SCHEMA: ClassVar[str] = "litho-models/blind-trial-draws/1"
    FILE_NAME: ClassVar[str] = "draws.json"

    seed: int
    n_scans: int
    size_px: int
    trials: list[Draw]


class Planted(Record):
    """A knob as it was set.

    Attributes:
        name: of the knob; ``effect``: identifier in the effects catalogue, or `off-catalogue`.
        strength: in ``unit``; ``at_limit``: the knob's range ended before the wanted size was reached.
        rms_nm: noise-free scans with minus without the knob, freed of {1, P, x, y, x², xy, y²} per scan.
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
    """One effect that the loop added outside the nuisance span, and those that look the same."""

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
    """Wall seconds of build and loop, and processor seconds of the whole trial with its judging."""

    build_s: float
    loop_s: float
    cpu_s: float


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
    """The figures that the campaign is about.

    Attributes:
        single_found: right or contained, of the trials with one effect above the size that counts.
        single_not_testable: of the others among them, those whose effect the loop says it cannot test.
        effects_found: the same per effect, pairs included.
        without_stranger: of ``effects_found``, those in trials where nothing false was named beside it.
        clean: trials without an effect in which none was reported outside the nuisance span.
        honest: off-catalogue trials in which no cause was named.
        at_floor: trials whose error after is at most the tolerated multiple of the floor.
        failed: trials that ended with an error; they count as not found.
    """

    counts_from_rms_nm: float
    floor_tolerance: float
    single_found: Tally
    single_not_testable: int
    effects_found: Tally
    without_stranger: Tally
    clean: Tally
    honest: Tally
    at_floor: Tally
    failed: int
    mean_cpu_s: float | None
    longest_loop_s: float | None


class Scoreboard(Result):
    """All trials of a campaign; ``pending`` are drawn but not run."""

    SCHEMA: ClassVar[str] = "litho-models/blind-trials/1"
    FILE_NAME: ClassVar[str] = "scoreboard.json"

    command: str
    commit: str
    versions: dict[str, str]
    seed: int
    n_scans: int
    size_px: int
    pending: list[int]
    summary: Summary
    trials: list[Trial]
