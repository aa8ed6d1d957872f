"""For each monitored quantity, judge whether it has changed, and estimate when it should be measured again.
The functions of this module work on values of scans and need neither files nor models.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from litho_models.monitoring.change_point import (
    Series,
    likeliest_step,
    noticeable_step,
)
from litho_models.monitoring.prints import (
    FIGURES,
    Alarm,
    Figure,
    FigureCheck,
    print_values,
    printing_order,
    spread_of,
)
from litho_models.scoring.printer_state import ScanFigures


class Trend(NamedTuple):
    """A straight line through the values of prints in printing order.

    Attributes:
        per_print: slope of the line, which is the change from print to print.
        ci95: 95 % confidence interval of ``per_print``.
        p: two-sided p value for the hypothesis that the slope is zero.
        prints_left: number of further prints until the 95 % bound on the drift reaches the tolerance.
    """

    per_print: float
    ci95: tuple[float, float]
    p: float
    prints_left: int


def forecast(values: np.ndarray, variance: np.ndarray, reference: np.ndarray, tolerance: float) -> Trend:
    """Fit a straight trend to the values of all prints, and estimate the number of prints until the drift may
    reach the tolerance.

    The drift is the slope of the trend times the number of prints since the model was made. The model is
    assumed to have been made at the middle of the reference prints. The 95 % bound on the drift is computed
    with the steeper end of the slope's confidence interval. The forecast assumes a steady drift. Sudden steps
    are not included, because they raise an alarm.

    Args:
        values: one value per print in printing order, with shape (n,); at least three.
        variance: relative variances of the values, with shape (n,).
        reference: boolean array of shape (n,), True for reference prints.
        tolerance: largest allowed drift, in the unit of ``values``.
    """
    n = len(values)
    place = np.arange(n)
    (slope, _), covariance = np.polyfit(place, values, 1, w=np.sqrt(1 / variance), cov=True)
    error = float(np.sqrt(covariance[0, 0]))
    half = float(student.ppf(0.975, n - 2)) * error
    fastest = max(abs(slope - half), abs(slope + half))
    since_middle = n - 1 - float(place[reference].mean())
    # A forecast beyond a million prints is meaningless.
    left = int(np.clip(tolerance / fastest - since_middle, 0, 1e6)) if fastest > 0 else 10**6
    p = 2 * float(student.sf(abs(slope) / error, n - 2)) if error > 0 else float(slope == 0)
    return Trend(float(slope), (slope - half, slope + half), p, left)


DEFAULT_RATE = 0.005
# Default tolerance, as a multiple of the spread between reference prints.
TOLERANCE_SPREADS = 3.0


def judge(
    reference: Sequence[ScanFigures],
    new: Sequence[ScanFigures],
    *,
    rate: float = DEFAULT_RATE,
    tolerance: float | None = None,
    figures: Sequence[Figure] = FIGURES,
    between: bool = False,
) -> list[FigureCheck]:
    """Compare the new prints with the reference prints in every monitored quantity.

    Args:
        reference, new: values of the scans of these prints, in any order; there must be at least three
            reference prints.
        rate: probability of a false alarm if nothing has changed. This probability is divided among the
            quantities in proportion to their weights.
        tolerance: largest allowed relative drift of a quantity; by default three times its spread between
            reference prints.
        between: True if new prints may have been made between reference prints. The trend is then fitted to
            all prints in their common printing order. If False, all new prints are assumed to follow the
            reference prints.
    """
    return [
        _judged(figure, reference, new, own, tolerance, between=between)
        for figure, own in zip(figures, rates(rate, figures), strict=True)
    ]


def rates(rate: float, figures: Sequence[Figure] = FIGURES) -> list[float]:
    """Divide the rate of false alarms among the quantities, and return the part of each quantity."""
    total = sum(figure.weight for figure in figures)
    return [rate * figure.weight / total for figure in figures]


def _judged(
    figure: Figure,
    reference: Sequence[ScanFigures],
    new: Sequence[ScanFigures],
    rate: float,
    tolerance: float | None,
    *,
    between: bool,
) -> FigureCheck:
    old, now = print_values(reference, figure), print_values(new, figure)
    spread = spread_of(reference, figure)
    variances = spread.relative_variance(old.counts), spread.relative_variance(now.counts)
    step, p = likeliest_step(Series(old.values, now.values, *variances))
    noticeable = spread.sd * noticeable_step(*variances, rate)
    allowed = tolerance if tolerance is not None else TOLERANCE_SPREADS * spread.sd
    order = printing_order(reference, new, between=between)
    values, variance = np.concatenate([old.values, now.values])[order], np.concatenate(variances)[order]
    trend = forecast(values, variance, order < len(old.names), allowed)
    return FigureCheck(
        name=figure.name,
        mean=float(np.exp(spread.mean)),
        spread=spread.sd,
        spread_ci95=spread.sd_ci95,
        reference_prints=len(old.values),
        new_prints=len(now.values),
        alarm=None
        if p > rate
        else Alarm(
            since=now.names[step.since],
            step=float(np.expm1(step.size)),
            step_ci95=(float(np.expm1(step.ci95[0])), float(np.expm1(step.ci95[1]))),
        ),
        p=p,
        alarm_at=rate,
        noticeable_step=float(np.expm1(noticeable)) if noticeable < 1 else None,
        tolerance=allowed,
        trend=trend.per_print,
        trend_ci95=trend.ci95,
        trend_p=trend.p,
        measure_again_in=0 if p <= rate else trend.prints_left,
    )
