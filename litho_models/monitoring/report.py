"""Write ``report.html`` of a check: the verdict, a control chart for each figure, and a table of scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.reports.page import Page
from litho_data.reports.pictures import LIGHT, new_figure
from litho_models.monitoring.prints import WATCHED, Check, FigureCheck, print_values

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS = (
    *("name", "mean", "spread", "p", "alarm_at", "alarm_since", "alarm_step", "noticeable_step", "trend"),
    *("trend_ci95", "measure_again_in"),
)


def write_check_report(result: Check, out: str | Path) -> Path:
    """Render the result into ``out``; return the page."""
    page = Page(f"Check of {result.model.name} on {result.dataset.name}", run=result.run)
    page.verdict(result.verdict[0])
    for one in result.figures:
        page.figure(control_chart(result, one), _chart_text(one))
    for sentence in result.verdict[1:]:
        page.paragraph(sentence)
    page.note(*result.notes)
    page.heading("In numbers", folded=True)
    page.table(
        result.figures,
        "Relative figures: 0.01 is 1 %. p: chance that unchanged prints look as changed at any print; "
        f"alarm if at most “alarm at”, the figure's share of {result.false_alarm_rate:g}.",
        "figures.csv",
        digits=4,
        columns=_COLUMNS,
    )
    scans = [
        {"set": name, **row.model_dump()}
        for name, rows in (("reference", result.reference_scans), ("new", result.new_scans))
        for row in rows
    ]
    page.table(scans, f"Every scan; reference: {result.reference}.", "scans.csv", digits=4)
    return page.write(out)


def control_chart(result: Check, one: FigureCheck) -> Figure:
    """Draw the figure of every print relative to the reference: large dots for prints, small dots for scans,
    the spread of the reference, and steps.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(8.5, 3.4)
    axes = figure.subplots()
    watched = WATCHED[one.name]
    start = 0
    for rows, colour, label in (
        (result.reference_scans, LIGHT["soft"], "reference"),
        (result.new_scans, LIGHT["accent"], "new"),
    ):
        prints = print_values(rows, watched)
        place = np.arange(start, start + len(prints.values))
        of_scans = [(place[prints.names.index(row.print)], _relative(watched.of(row), one)) for row in rows]
        axes.plot(*np.array(of_scans).T, ".", color=colour, alpha=0.6, ms=5)
        axes.plot(place, _relative(prints.values, one), "o", color=colour, label=label)
        if rows is result.new_scans and one.alarm is not None:
            since = start + prints.names.index(one.alarm.since)
            axes.axvspan(since - 0.5, place[-1] + 0.5, color="#c23b22", alpha=0.12, label="changed")
        start = place[-1] + 1
    spread = 100 * one.spread
    axes.axhline(0, color=LIGHT["ink"], lw=0.8)
    axes.axhspan(-spread, spread, color="#9aa7b5", alpha=0.25, label="spread of the reference")
    for sign in (-1, 1):
        axes.axhline(sign * 100 * one.tolerance, color="#d99b00", ls="--", lw=1)
    axes.axvline(one.reference_prints - 0.5, color=LIGHT["ink"], lw=0.8, ls=":")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="print, in printing order", ylabel="against the reference, %")
    axes.set_title(watched.words, fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=2)
    return figure


def _relative(value: float | np.ndarray, one: FigureCheck) -> np.ndarray:
    """Convert the logarithm of a figure to its difference from the reference mean, %."""
    return 100 * np.expm1(np.asarray(value) - np.log(one.mean))


def _chart_text(one: FigureCheck) -> str:
    unit = " nm" if one.name == "error" else ""
    return (
        f"Large dots are prints, small ones their scans. 0 is the mean of {one.reference_prints} reference "
        f"prints, {one.mean:.4g}{unit}; dashed: the tolerance, {100 * one.tolerance:.1f} %."
    )
