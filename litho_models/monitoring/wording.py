"""A check in plain words: the verdict, and what its reader should know."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_data.reports.page import capitalised
from litho_models.monitoring.change_point import SOON
from litho_models.monitoring.prints import FIGURES, Figure, FigureCheck, in_order
from litho_models.scan_terms import Blocks
from litho_models.scoring.metrics import ScanFigures

# A layout this much flatter, higher or steeper than every one of the reference is of another kind.
_OTHER_KIND = 1.1
# Optimism of a fit, in spreads, that a rate of false alarms still bears.
_BEARABLE_OPTIMISM = 0.25


def figure_of(check: FigureCheck) -> Figure:
    """What is watched, with its words."""
    return next(figure for figure in FIGURES if figure.name == check.name)


def verdict(checks: Sequence[FigureCheck], rate: float) -> list[str]:
    """Sentences, the one that matters first."""
    alarms = [check for check in checks if check.alarm is not None]
    new, old = checks[0].new_prints, checks[0].reference_prints
    said = []
    if not alarms:
        said.append(
            f"No alarm: {_count(new, 'new print')} cannot be told from the {old} of the reference. "
            f"(False alarms: at most {100 * rate:g} % of such data sets of an unchanged printer.)"
        )
    for check in alarms:
        said.append(_alarm_text(check))
    for check in checks:
        if check.alarm is None:
            said.append(_quiet_text(check))
    if alarms:
        said.append(
            "Measure again now, and make the model anew from prints since the change before designing with "
            "it."
        )
    else:
        said.append(_again_text(min(checks, key=lambda check: check.measure_again_in)))
    return said


def _alarm_text(check: FigureCheck) -> str:
    figure, alarm = figure_of(check), check.alarm
    assert alarm is not None
    low, high = (100 * end for end in alarm.step_ci95)
    way = "higher" if alarm.step > 0 else "lower"
    return (
        f"ALARM: since print {alarm.since} the {figure.words} is "
        f"{100 * abs(alarm.step):.1f} % {way} than before (95 %: {low:+.1f} to {high:+.1f} %); "
        f"unchanged prints differ by {100 * check.spread:.1f} %. It comes from {figure.causes}."
    )


def _quiet_text(check: FigureCheck) -> str:
    if check.noticeable_step is None:
        seen = "with so few reference prints hardly any step would be noticed"
    else:
        rise = check.noticeable_step
        seen = (
            f"a rise by {100 * rise:.1f} % or a fall by {100 * rise / (1 + rise):.1f} % is noticed within "
            f"{_count(min(SOON, check.new_prints), 'print')} in 9 of 10 cases"
        )
    low, high = (100 * end for end in check.spread_ci95)
    words = figure_of(check).words
    return (
        f"{capitalised(words)}: no change; unchanged prints differ by {100 * check.spread:.1f} % "
        f"(95 %: {low:.1f} to {high:.1f} %), {seen}."
    )


def _again_text(check: FigureCheck) -> str:
    words = figure_of(check).words
    fastest = 100 * max(abs(end) for end in check.trend_ci95)
    bound = (
        f"a drift of the {words} of {fastest:.2f} % per print, the fastest that these prints leave open, "
        f"{{}} {100 * check.tolerance:.1f} %"
    )
    if check.measure_again_in == 0:
        return f"Measure again now: {bound.format('may already have reached')}."
    return (
        f"Measure again after {_count(check.measure_again_in, 'more print')} at the latest: until then "
        f"{bound.format('stays below')}."
    )


def notes(
    reference: Sequence[ScanFigures], new: Sequence[ScanFigures], checks: Sequence[FigureCheck]
) -> list[str]:
    """What limits the verdict."""
    found = []
    for check in checks:
        # A step makes a trend too, and has been told.
        if check.trend_p < 0.05 and check.alarm is None:
            found.append(
                f"The {figure_of(check).words} has a trend over all prints: {100 * check.trend:+.2f} % per "
                f"print (95 %: {100 * check.trend_ci95[0]:+.2f} to {100 * check.trend_ci95[1]:+.2f} %, "
                f"p = {check.trend_p:.2g})."
            )
    if _other_layouts(reference, new):
        found.append(
            "Layouts of another kind: the new prints are higher, flatter or steeper than every reference "
            "print. What the model gets wrong there may look like a change."
        )
    if not all(row.held_out for row in new):
        found.append(
            "The model was made of some of the new prints: it has learned part of what they do. "
            "--residuals of a leave-one-print-out benchmark has errors of prints not seen."
        )
    scans = [len(rows) / len(in_order(rows)) for rows in (reference, new)]
    if max(scans) > 1.5 * min(scans):
        found.append(
            f"{scans[0]:.1f} scans per print in the reference, {scans[1]:.1f} in the new prints: allowed for "
            "by the spread of scans within a print."
        )
    return found


def optimism(reference: Sequence[ScanFigures], parameters: int) -> float:
    """By how much a fit makes the error of its own scans too small: parameters over independent pixels.

    Neighbours within a correlation length of the residual count once.
    """
    independent = sum(row.pixels for row in reference if not row.held_out) / Blocks().buffer_px ** 2
    return parameters / independent if independent else 0.0


def too_optimistic(reference: Sequence[ScanFigures], parameters: int) -> bool:
    """Whether errors of the reference are too small to compare those of prints not seen with."""
    errors = next(figure for figure in FIGURES if figure.name == "error")
    spread = float(np.std([errors.of(row) for row in reference], ddof=1))
    return optimism(reference, parameters) > _BEARABLE_OPTIMISM * spread


def _other_layouts(reference: Sequence[ScanFigures], new: Sequence[ScanFigures]) -> bool:
    for name in ("relief_nm", "steepness"):
        known, now = ([getattr(row, name) for row in rows] for rows in (reference, new))
        if min(now) > _OTHER_KIND * max(known) or max(now) < min(known) / _OTHER_KIND:
            return True
    return False


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")
