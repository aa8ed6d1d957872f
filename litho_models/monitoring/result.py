"""``check.json``: whether the printer still behaves as its model says, figure by figure."""

from __future__ import annotations

from typing import ClassVar

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId
from litho_models.scoring.scan_figures import ScanFigures


class CheckedModel(Record):
    """Name and hash of the model, and the dataset it was made of."""

    name: str
    sha256: str
    dataset: DatasetId | None


class Alarm(Record):
    """A step in the mean of a figure, relative; ``since``: the first changed print.

    ``step``: mean from ``since`` on minus the mean before, with an interval that does not allow for the
    choice of ``since``.
    """

    since: str
    step: float
    step_ci95: tuple[float, float]


class FigureCheck(Record):
    """One figure of the new prints against the reference; all but ``mean`` are relative, 0.01 is 1 %.

    ``mean`` and ``spread``: of the reference prints. ``p``: chance, at most, that unchanged prints look as
    changed; an alarm at ``alarm_at``, the figure's share of the rate, or less. ``noticeable_step``: the rise
    r that three new prints show in 9 of 10 cases (all new ones, if these are fewer), and so is a fall by
    r/(1 + r); None where it is beyond a factor of e. ``trend``: change per print over all prints.
    ``measure_again_in``: prints until the 95 % bound of the drift reaches ``tolerance``.
    """

    name: str
    mean: float
    spread: float
    spread_ci95: tuple[float, float]
    reference_prints: int
    new_prints: int
    alarm: Alarm | None
    p: float
    alarm_at: float
    noticeable_step: float | None
    tolerance: float
    trend: float
    trend_ci95: tuple[float, float]
    trend_p: float
    measure_again_in: int


class Check(Result):
    """``check.json``; ``verdict`` is for people, ``alarm`` for machines.

    ``false_alarm_rate``: chance that a data set like this of an unchanged printer raises an alarm.
    """

    SCHEMA: ClassVar[str] = "litho-models/check/2"
    FILE_NAME: ClassVar[str] = "check.json"

    run: RunInfo
    dataset: DatasetId
    model: CheckedModel
    reference: str
    false_alarm_rate: float
    alarm: bool
    verdict: list[str]
    figures: list[FigureCheck]
    reference_scans: list[ScanFigures]
    new_scans: list[ScanFigures]
    notes: list[str]
