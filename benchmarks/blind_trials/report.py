"""The scoreboard as a page for people, with two figures and the table as CSV."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.blind_trials.records import COUNTS_FROM_RMS_NM, Scoreboard, Trial
from benchmarks.blind_trials.scoreboard import (
    TOLERANCE_IN_FORM,
    TOLERANCE_OTHER,
    figures_of,
    reaches_floor,
    summarise,
    tolerance,
    trial_table,
)
from benchmarks.blind_trials.trial import trial_folder
from litho_data.foundation.report import Page
from litho_data.foundation.report_pictures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CSV_NAME = "scoreboard.csv"
_GOOD, _FAIR, _SILENT, _BAD = "#1b7f4b", "#6fbf8f", "#9aa5b1", "#c0392b"
_LOOKS = {
    "right": (_GOOD, "o"),
    "set-contains-it": (_FAIR, "o"),
    "absorbed": (_FAIR, "o"),
    "partial": (_FAIR, "D"),
    "clean": (_GOOD, "o"),
    "traced-to-covariate": (_GOOD, "D"),
    "unexplained": (_FAIR, "D"),
    "missed": (_SILENT, "s"),
    "wrong": (_BAD, "X"),
    "false-positive": (_BAD, "X"),
    "named-a-cause": (_BAD, "X"),
    "failed": ("black", "X"),
}


def write_report(scoreboard: Scoreboard, folder: Path) -> Path:
    """Write ``report.html`` and the CSV table into ``folder``; returns the path of the page."""
    page = Page(
        "Blind trials of the closed loop",
        "The virtual fab hides causes drawn from one seed; the loop sees scans and layouts only; "
        "a judge who knows the answer compares. All draws are shown, none was repeated.",
        facts={"seed": scoreboard.seed, "command": scoreboard.command},
    )
    s = scoreboard.summary or summarise(scoreboard.trials)
    page.verdict(
        f"Of causes whose law the loop knows it named {s.in_form}. Of causes of another form it noticed "
        f"{s.noticed} without a name, gave {s.named} a name and overlooked {s.unnoticed}. Where nothing was "
        f"planted it reported nothing in {s.clean}."
    )
    if scoreboard.pending:
        page.note(f"Not run yet: trials {', '.join(map(str, scoreboard.pending))}.")
    page.tiles(
        [
            (one.value, f"{one.what} (wanted: {one.wanted})" if one.wanted else one.what)
            for one in figures_of(scoreboard)
        ]
    )
    if scoreboard.trials:
        page.heading("Outcome against size")
        page.figure(
            _outcomes(scoreboard.trials),
            f"One row per planted cause. The dashed line is {COUNTS_FROM_RMS_NM:g} nm: what lies to its left "
            "does not count. Trials without a cause stand at the left edge.",
        )
        page.heading("Error before, after, and of the true models")
        page.figure(
            _errors(scoreboard.trials),
            "Mean absolute error on held-out scans, datum-free: from the base model (open) to the corrected "
            "one (filled). Black: the true models on the same pixels; grey band: up to "
            f"{TOLERANCE_IN_FORM:g} times that, with a cause of another form {TOLERANCE_OTHER:g}.",
        )
        page.heading("All trials", folded=True)
        page.table(trial_table(scoreboard), "One row per planted cause.", CSV_NAME)
        numbers = [trial.draw.number for trial in scoreboard.trials if not trial.failure]
        page.links(
            [
                (str(trial_folder(Path(), n) / "loop" / "report.html"), f"what the loop wrote on trial {n}")
                for n in numbers
            ]
        )
    return page.write(folder)


def _outcomes(trials: list[Trial]) -> Figure:
    rows = [
        (f"{label} · {trial.draw.number}", outcome)
        for trial in trials
        for label, outcome in zip(_labels(trial), trial.outcomes, strict=True)
    ]
    rows.sort(key=lambda row: row[1].rms_nm)
    figure = new_figure(9, 1.2 + 0.24 * len(rows))
    axes = figure.add_subplot()
    for judgement, (colour, marker) in _LOOKS.items():
        places = [(max(o.rms_nm, 0.5), y) for y, (_, o) in enumerate(rows) if o.judgement == judgement]
        if places:
            x, y = zip(*places, strict=True)
            axes.scatter(x, y, c=colour, marker=marker, s=48, label=judgement, zorder=3)
    axes.axvline(COUNTS_FROM_RMS_NM, color="0.4", linestyle="--", linewidth=1)
    axes.set_xscale("log")
    _plain_ticks(axes, (1, 2, 4, 8, 15, 30, 60))
    axes.set_xlabel("rms of the cause (nm)")
    axes.set_yticks(range(len(rows)), [label for label, _ in rows], fontsize=8)
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1), fontsize=8, frameon=False)
    return figure


def _errors(trials: list[Trial]) -> Figure:
    done = [(trial, trial.errors) for trial in trials if trial.errors]
    figure = new_figure(9, 1.2 + 0.26 * max(len(done), 1))
    axes = figure.add_subplot()
    for y, (trial, errors) in enumerate(done):
        floor, before, after = errors.floor.mae_nm, errors.before.mae_nm, errors.after.mae_nm
        colour = _GOOD if reaches_floor(trial) else _BAD
        axes.fill_betweenx(
            [y - 0.35, y + 0.35], floor, tolerance(trial) * floor, color="#9aa7b5", alpha=0.35, lw=0
        )
        axes.plot([before, after], [y, y], color=colour, linewidth=1.2)
        axes.scatter([before], [y], facecolors="white", edgecolors=colour, s=34, zorder=3)
        axes.scatter([after], [y], color=colour, s=34, zorder=3)
        axes.plot([floor, floor], [y - 0.35, y + 0.35], color="black", linewidth=1.6, zorder=4)
    labels = [f"{' + '.join(_labels(trial))} · {trial.draw.number}" for trial, _ in done]
    axes.set_yticks(range(len(done)), labels, fontsize=8)
    axes.set_xscale("log")
    _plain_ticks(axes, (8, 10, 12, 15, 20, 30, 50, 80, 120, 200))
    axes.set_xlabel("mean absolute error, held-out, datum-free (nm)")
    axes.grid(axis="x", alpha=0.3)
    axes.invert_yaxis()
    return figure


def _plain_ticks(axes: Axes, values: Sequence[float]) -> None:
    """Those of the values that the logarithmic axis shows, written out."""
    low, high = axes.get_xlim()
    shown = [value for value in values if low <= value <= high]
    axes.set_xticks(shown, [f"{value:g}" for value in shown])
    axes.set_xticks([], minor=True)


def _labels(trial: Trial) -> list[str]:
    return [one.name for one in trial.planted] or [outcome.effect for outcome in trial.outcomes]
