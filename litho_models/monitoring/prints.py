"""Define the record ``check.json`` and the monitored quantities. A quantity has one value per print. The
module also computes how much these values differ from print to print.
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

    ``words`` is the name of the quantity in sentences, and ``causes`` lists what may change it. ``of`` is a
    function that returns the logarithm of the quantity for one scan. Differences of logarithms are relative
    changes, so a step of 0.03 is 3 %. ``weight`` determines which share of the rate of false alarms the
    quantity gets.
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
        # The gain of a failed print may be near or below 0. A lower limit on the gain keeps its logarithm
        # finite.
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
    """The mean and the variation of a quantity over unchanged prints.

    Attributes:
        mean: mean of the values of the prints.
        sd: standard deviation of the values of the prints.
        sd_ci95: 95 % confidence interval of ``sd``.
        between: variance that comes from differences between prints.
        within: variance between the scans of one print; None if no print has two scans.
    """

    mean: float
    sd: float
    sd_ci95: tuple[float, float]
    between: float
    within: float | None

    def relative_variance(self, counts: np.ndarray) -> np.ndarray:
        """Return the relative variance of the value of each print, which depends on the number of its scans.
        ``counts`` and the result have shape (n,). The relative variance of a typical print is 1.
        """
        if self.within is None:
            return np.ones(len(counts))
        variance = self.between + self.within / counts
        return variance / self.sd**2 if self.sd > 0 else np.ones(len(counts))


def in_order(rows: Sequence[ScanFigures]) -> list[str]:
    """Return the names of the prints in printing order. The position of a print is the position of its first
    scan.
    """
    return [*dict.fromkeys(row.print for row in sorted(rows, key=lambda row: (row.order, row.print)))]


def printing_order(
    reference: Sequence[ScanFigures], new: Sequence[ScanFigures], *, between: bool
) -> np.ndarray:
    """Return the printing order of all prints, as indices into a list of all prints. In this list, the
    reference prints come first, and the new prints follow. ``between`` has the same meaning as in ``judge``.
    """
    names = [*in_order(reference), *in_order(new)]
    if not between:
        return np.arange(len(names))
    return np.array([names.index(name) for name in in_order([*reference, *new])])


def print_values(rows: Sequence[ScanFigures], figure: Figure) -> PrintValues:
    """Return the value of a monitored quantity for each print, in printing order."""
    names = in_order(rows)
    of_print = [[figure.of(row) for row in rows if row.print == name] for name in names]
    return PrintValues(
        names, np.array([np.mean(part) for part in of_print]), np.array([len(part) for part in of_print])
    )


def spread_of(rows: Sequence[ScanFigures], figure: Figure) -> Spread:
    """Compute the mean and the spread of a quantity over at least two prints. A one-way analysis of variance
    splits the variance into a part between prints and a part within prints.

    Both parts are needed, because a mean over several scans of a print varies less than the value of a single
    scan. The variance within prints is known only if some prints have several scans. A negative estimate of
    the variance between prints is set to 0.
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
    # The variance of the means of the prints is the variance between prints plus the mean contribution of the
    # scans.
    between = max(sd**2 - (within or 0.0) * float(np.mean(1 / prints.counts)), 0.0)
    return Spread(mean, sd, (ends[0], ends[1]), between, within)


class CheckedModel(Record):
    """Name and hash of the model that is checked, and the dataset on which it was trained."""

    name: str
    sha256: str
    dataset: DatasetId | None


class Alarm(Record):
    """A step in the mean of a monitored quantity. ``since`` is the name of the first print after the step.

    ``step`` is the mean of the prints from ``since`` on, minus the mean of the earlier prints, relative to
    the mean of the earlier prints. The confidence interval of ``step`` does not account for the choice of
    ``since``.
    """

    since: str
    step: float
    step_ci95: tuple[float, float]


class FigureCheck(Record):
    """The comparison of new prints with reference prints in one monitored quantity. ``mean`` is the geometric
    mean of the quantity. All other values of the quantity are relative differences (0.01 is 1 %).

    ``mean`` and ``spread`` describe the reference prints. ``p`` is an upper bound on the p value of a change.
    If ``p`` is at most ``alarm_at``, there is an alarm. ``alarm_at`` is the part of the rate of false alarms
    that is allotted to this quantity. ``noticeable_step`` is the rise r that raises an alarm with a
    probability of 90 % within three new prints, or within all new prints if there are fewer than three. A
    fall by r/(1 + r) raises an alarm equally often. If the quantity would have to rise by more than a factor
    of e, ``noticeable_step`` is None. ``trend`` is the change from print to print, fitted to all prints.
    ``measure_again_in`` is the number of prints until the 95 % bound on the drift reaches ``tolerance``;
    after an alarm, it is 0.
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
    """The record ``check.json``. ``verdict`` states the result in sentences for people, and ``alarm`` states
    the result for programs.

    ``false_alarm_rate`` is the probability of an alarm for a dataset of this size if the printer is
    unchanged.
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
