"""The records of a board: drawn trials, hidden causes, answers, judged trials and the scoreboard."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from litho_data.foundation.results import Record, Result

Board = Literal["singles", "mixtures"]
Kind = Literal["in-form", "alias", "other-form", "empty", "mixture", "measured"]
# Causes whose size (rms) is at most this value are listed, but they do not count in the headline results.
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
    """A drawn cause. It contains the name of a knob (setting of the virtual fab) or of a form from
    ``other_forms``, and the size that the cause should have.

    The size is defined as in `Planted.rms_nm`. Trials of kind ``alias`` are an exception; see `plant`.

    Attributes:
        by: how the strength varies. With ``all``, it is the same in all scans. With ``batch``, it is
            multiplied by ``weak`` in all scans after ``place`` in the printing order. With ``field``, it is
            multiplied by ``weak`` in all scans whose id does not end in one of the digits of ``place``.
    """

    name: str
    wanted_rms_nm: float
    by: Literal["all", "batch", "field"] = "all"
    place: str = ""
    weak: float = 1.0


class Draw(Record):
    """One trial as drawn.

    Attributes:
        seed: determines the layouts, the noise, and the random values of knobs and forms.
        printer: the parameters in which the printer of this trial differs from the default printer.
        base: form that changes the printer so that the Physics model cannot imitate it, or None.
    """

    number: int
    kind: Kind
    seed: int
    causes: list[CauseDraw]
    printer: dict[str, float] = Field(default_factory=dict)
    base: CauseDraw | None = None


class Draws(Result):
    """All drawn trials of a board, written before any trial runs. ``base`` is the model that the loop
    corrects.
    """

    SCHEMA = "litho-models/blind-trial-draws/2"
    FILE_NAME = "draws.json"

    board: Board
    seed: int
    n_scans: int
    size_px: int
    base: str
    trials: list[Draw]


class Planted(Record):
    """A knob or a form with the strength at which it is planted.

    Attributes:
        names: names in the loop's catalogue of effects that count as a right answer.
        strength: strength, in ``unit``.
        at_limit: whether the strength is the largest allowed strength, because the drawn size could not be
            reached.
        rms_nm: size of the cause, nm. It is the rms of the residual in noise-free scans that contain only
            this cause, after the base model, the per-scan terms and the registration are refitted.
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
    """The hidden causes of one store; the loop does not see this file."""

    SCHEMA = "litho-models/board-hidden/1"
    FILE_NAME = "hidden.json"

    planted: list[Planted]


class Outcome(Record):
    """The outcome of one planted cause, or of the whole trial if nothing was planted."""

    name: str
    verdict: Verdict


class TrialErrors(Record):
    """Mean absolute errors, nm, of the base model, of the corrected model and of the true models. All three
    errors are computed on held-out scans, with one term (the datum) fitted to each scan.

    ``floor_nm``, the error of the true models, is None for measured prints, whose true models are unknown.
    """

    before_nm: float
    after_nm: float
    floor_nm: float | None

    @property
    def ratio(self) -> float | None:
        """Return the error of the corrected model divided by the error of the true models."""
        return self.after_nm / self.floor_nm if self.floor_nm else None


class Found(Record):
    """One finding of a loop.

    Attributes:
        names: name of the effect in the loop's catalogue, followed by the names of effects that cannot be
            distinguished from it.
        by: how the strength varies. ``all``: one strength for all scans; ``scan``: one strength per scan. Any
            other text is the name of a grouping, with one strength per group of scans.
        exponents: confidence intervals of the exponent, if the finding is a power law.
    """

    names: list[str]
    knowledge: Literal["cause", "law", "description"]
    by: str = "all"
    exponents: list[tuple[float, float]] = Field(default_factory=list)


class Answer(Result):
    """The answer of a loop for one store.

    Attributes:
        found: causes, laws and descriptions.
        left: whether the residual has structure that the loop cannot explain.
        absorbed: names of effects that the loop cannot detect, because its base model can absorb them.
        displaced_by: names of groupings (as in `Found.by`). The loop found that the scans of each group of
            such a grouping share a displacement along x.
        before_nm, after_nm: mean absolute error of the model without and with the findings, over the scans
            that are not locked. Each scan is predicted by a model that was fitted to other scans, and one
            offset is fitted to the scan before the error is computed. None if the loop does not state the
            error.
        base_values, corrected_values: fitted values of the Physics model, without and with the findings.
    """

    SCHEMA = "litho-models/board-answer/1"
    FILE_NAME = "answer.json"

    found: list[Found] = Field(default_factory=list)
    left: bool = False
    absorbed: list[str] = Field(default_factory=list)
    displaced_by: list[str] = Field(default_factory=list)
    before_nm: float | None = None
    after_nm: float | None = None
    base_values: dict[str, float] = Field(default_factory=dict)
    corrected_values: dict[str, float] = Field(default_factory=dict)


class Trial(Result):
    """The result of one judged trial. For a failed trial, ``errors`` is None and ``failure`` says why it
    failed.

    Attributes:
        false_names: the findings that name a cause but are the right answer for none of the planted causes.
            Each finding is given by the names of its effects.
        bias: median relative error of the base model's values, without and with the findings; None if the
            printer or the base model is not a Physics model.
        dataset_cpu_s: CPU time that the loop used, s. In the published boards, it includes the time to build
            the store.
    """

    SCHEMA = "litho-models/blind-trial/2"
    FILE_NAME = "trial.json"

    draw: Draw
    planted: list[Planted]
    outcomes: list[Outcome]
    false_names: list[str] = Field(default_factory=list)
    found: list[Found] = Field(default_factory=list)
    errors: TrialErrors | None = None
    bias: tuple[float, float] | None = None
    dataset_cpu_s: float | None = None
    failure: str = ""


class Scoreboard(Result):
    """All judged trials of a board. ``pending`` lists the numbers of trials that were drawn but not run, and
    ``command`` is the command line that reproduces the scoreboard.

    ``loop`` is the name of the judged loop, and ``draws_sha256`` is the hash of the judged board's
    ``draws.json``.
    """

    SCHEMA = "litho-models/blind-trials/3"
    FILE_NAME = "scoreboard.json"

    command: str
    commit: str
    versions: dict[str, str]
    board: Board
    seed: int
    loop: str = ""
    draws_sha256: str = ""
    pending: list[int]
    trials: list[Trial]
