"""Define the record ``check.json`` and the monitored quantities, each with one value per print and the spread
of these values.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunInfo
from litho_data.store.schema import DatasetId
from litho_models.scoring.printer_state import ScanFigures

_LEAST_GAIN = 0.01


class Figure(NamedTuple):
    """A monitored quantity.

    ``of`` returns the logarithm of the quantity for one scan, so that differences are relative: a step of
    0.03 is 3 %. ``weight`` is the quantity's share of the rate of false alarms.
    """

    name: str
    words: str
    of: Callable[[ScanFigures], float]
    causes: str
    weight: float


FIGURES = (
    Figure(
        "gain",
        "height gain",
        # A failed print may have a gain near or below 0.
        lambda scan: float(np.log(max(scan.gain, _LEAST_GAIN))),
        "the printer (dose, development) or the height scale of the microscope: a scan of a step of known "
        "height tells them apart",
        0.8,
    ),
    Figure(
        "error",
        "error beyond offset, gain, tilt and bow",
        lambda scan: float(np.log(scan.error_nm)),
        "rougher or blurred prints, an effect that the model lacks, layouts of another kind, or the tip of "
        "the microscope: a scan of an older print with the same tip tells them apart",
        0.2,
    ),
)
WATCHED = {figure.name: figure for figure in FIGURES}


class PrintValues(NamedTuple):
    """The name, the value and the number of scans of each print, in printing order. The value of a print is
    the mean over its scans.
    """

    names: list[str]
    values: np.ndarray
    counts: np.ndarray


class Spread(NamedTuple):
    """The variation of unchanged prints.

    Attributes:
        mean: mean over the prints.
        sd: standard deviation between prints.
        sd_ci95: 95 % confidence interval of ``sd``.
        between: variance between prints.
        within: variance between the scans of a print; None if no print has two scans.
    """

    mean: float
    sd: float
    sd_ci95: tuple[float, float]
    between: float
    within: float | None

    def relative_variance(self, counts: np.ndarray) -> np.ndarray:
        """Return the relative variance of the value of each print, (n,). The variance depends on the number
        of scans of the print. It is 1 for a typical print.
        """
        if self.within is None:
            return np.ones(len(counts))
        variance = self.between + self.within / counts
        return variance / self.sd**2 if self.sd > 0 else np.ones(len(counts))


def in_order(rows: Sequence[ScanFigures]) -> list[str]:
    """Return the prints in printing order, by the first scan of each."""
    return [*dict.fromkeys(row.print for row in sorted(rows, key=lambda row: (row.order, row.print)))]


def print_values(rows: Sequence[ScanFigures], figure: Figure) -> PrintValues:
    """Return the value of each print, in printing order."""
    names = in_order(rows)
    of_print = [[figure.of(row) for row in rows if row.print == name] for name in names]
    return PrintValues(
        names, np.array([np.mean(part) for part in of_print]), np.array([len(part) for part in of_print])
    )


def spread_of(rows: Sequence[ScanFigures], figure: Figure) -> Spread:
    """Compute the mean and spread over at least two prints, with variance components from a one-way analysis
    of variance.

    A value from one scan varies more than a mean over four scans. Prints with several scans show how much of
    the variation comes from the scans. A negative variance between prints counts as 0.
    """
    prints = print_values(rows, figure)
    n = len(prints.values)
    mean, sd = float(prints.values.mean()), float(prints.values.std(ddof=1))
    freedom = n - 1
    ends = tuple(float(sd * np.sqrt(freedom / chi2.ppf(level, freedom))) for level in (0.975, 0.025))
    scans, rest = int(prints.counts.sum()), 0.0
    for name, value in zip(prints.names, prints.values, strict=True):
        rest += sum((figure.of(row) - value) ** 2 for row in rows if row.print == name)
    within = rest / (scans - n) if scans > n else None
    # The variance of the prints' means is the variance between prints plus the mean contribution of the
    # scans.
    between = max(sd**2 - (within or 0.0) * float(np.mean(1 / prints.counts)), 0.0)
    return Spread(mean, sd, (ends[0], ends[1]), between, within)


class CheckedModel(Record):
    """Name and hash of the model, and the dataset from which it was made."""

    name: str
    sha256: str
    dataset: DatasetId | None


class Alarm(Record):
    """A relative step in the mean of a monitored quantity; ``since`` is the first changed print.

    ``step`` is the mean from ``since`` on minus the mean before. Its confidence interval does not account for
    the choice of ``since``.
    """

    since: str
    step: float
    step_ci95: tuple[float, float]


class FigureCheck(Record):
    """One monitored quantity of the new prints, compared with the reference. All values except ``mean`` are
    relative: 0.01 is 1 %.

    ``mean`` and ``spread`` are those of the reference prints. ``p`` is an upper bound on the p value of a
    change. An alarm is raised if ``p`` is at most ``alarm_at``, the quantity's share of the rate.
    ``noticeable_step`` is a rise r that is noticed in 9 of 10 cases within three new prints, or within all
    new prints if there are fewer than three. A fall by r/(1 + r) is noticed equally often.
    ``noticeable_step`` is None if the rise exceeds a factor of e. ``trend`` is the change per print over all
    prints. ``measure_again_in`` is the number of prints until the 95 % bound on the drift reaches
    ``tolerance``.
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
    """The record ``check.json``. ``verdict`` is meant for people, and ``alarm`` is meant for programs.

    ``false_alarm_rate`` is the chance that a data set like this from an unchanged printer raises an alarm.
    """

    SCHEMA = "litho-models/check/2"
    FILE_NAME = "check.json"

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
