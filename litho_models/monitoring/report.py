"""Write the ``report.html`` of a check. The report contains the verdict, a control chart for each monitored
quantity, and a table of scans.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.reports.page import Page
from litho_data.reports.pictures import LIGHT, new_figure
from litho_models.monitoring.prints import WATCHED, Check, FigureCheck, print_values, printing_order

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS = (
    *("name", "mean", "spread", "p", "alarm_at", "alarm_since", "alarm_step", "noticeable_step", "trend"),
    *("trend_ci95", "measure_again_in"),
)


def write_check_report(result: Check, out: str | Path, *, between: bool) -> Path:
    """Write the report of a check into the folder ``out``, and return the path of the report. ``between`` is
    True if new prints may have been made between reference prints.
    """
    page = Page(f"Check of {result.model.name} on {result.dataset.name}", run=result.run)
    page.verdict(result.verdict[0])
    for one in result.figures:
        page.figure(control_chart(result, one, between=between), _chart_text(one))
    for sentence in result.verdict[1:]:
        page.paragraph(sentence)
    page.note(*result.notes)
    page.heading("In numbers", folded=True)
    page.table(
        result.figures,
        "All values except the mean are relative: 0.01 is 1 %. p is the probability that the prints of an "
        "unchanged printer seem to change as clearly as these, no matter at which print. An alarm is raised "
        "if p is at most the value in “alarm at”. This value is the quantity's share of the rate of false "
        f"alarms, {result.false_alarm_rate:g}.",
        "figures.csv",
        digits=4,
        columns=_COLUMNS,
    )
    scans = [
        {"set": name, **row.model_dump()}
        for name, rows in (("reference", result.reference_scans), ("new", result.new_scans))
        for row in rows
    ]
    page.table(scans, f"All scans. The reference is {result.reference}.", "scans.csv", digits=4)
    return page.write(out)


def control_chart(result: Check, one: FigureCheck, *, between: bool) -> Figure:
    """Draw one monitored quantity for all prints, relative to the mean of the reference prints. Large dots
    are prints and small dots are scans. One band shows the spread of the reference prints. If there is an
    alarm, another band marks each changed print. Dashed lines mark the tolerance. A dotted line separates
    reference and new prints, unless new prints may have been made between reference prints.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(8.5, 3.4)
    axes = figure.subplots()
    watched = WATCHED[one.name]
    order = printing_order(result.reference_scans, result.new_scans, between=between)
    places = np.split(np.argsort(order), [one.reference_prints])
    for place, rows, colour, label in (
        (places[0], result.reference_scans, LIGHT["soft"], "reference"),
        (places[1], result.new_scans, LIGHT["accent"], "new"),
    ):
        prints = print_values(rows, watched)
        of_scans = [(place[prints.names.index(row.print)], _relative(watched.of(row), one)) for row in rows]
        axes.plot(*np.array(of_scans).T, ".", color=colour, alpha=0.6, ms=5)
        axes.plot(place, _relative(prints.values, one), "o", color=colour, label=label)
        if rows is result.new_scans and one.alarm is not None:
            changed = place[prints.names.index(one.alarm.since) :]
            for number, at in enumerate(changed):
                told = "" if number else "changed"
                axes.axvspan(at - 0.5, at + 0.5, color="#c23b22", alpha=0.12, lw=0, label=told)
    spread = 100 * one.spread
    axes.axhline(0, color=LIGHT["ink"], lw=0.8)
    axes.axhspan(-spread, spread, color="#9aa7b5", alpha=0.25, label="spread of the reference")
    for sign in (-1, 1):
        axes.axhline(sign * 100 * one.tolerance, color="#d99b00", ls="--", lw=1)
    if not between:
        axes.axvline(one.reference_prints - 0.5, color=LIGHT["ink"], lw=0.8, ls=":")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="print, in printing order", ylabel="difference from the reference, %")
    axes.set_title(watched.words, fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=2)
    return figure


def _relative(value: float | np.ndarray, one: FigureCheck) -> np.ndarray:
    """From the logarithm of a quantity, compute by how many per cent the quantity differs from the mean of
    the reference prints.
    """
    return 100 * np.expm1(np.asarray(value) - np.log(one.mean))


def _chart_text(one: FigureCheck) -> str:
    unit = " nm" if one.name == "error" else ""
    return (
        "Large dots are prints, and small dots are their scans. Differences are relative to the mean of "
        f"{one.reference_prints} reference prints, {one.mean:.4g}{unit}. Dashed lines mark the tolerance of "
        f"{100 * one.tolerance:.1f} %."
    )
