"""The picture of the paper's own search beside ours: every element in design and in print."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from benchmarks.gap.paper_tables import ARMS, FAB, MEASURED, NAMES, made_kinds, task_name
from benchmarks.gap.tables import LABELS, SHOWN, TITLES
from litho_data.foundation.report_pictures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {"paper": "#c2571a", "ours": "#0b6aa2"}
_MARKERS = {333: "o", 1000: "D"}
# Lines of one arm, in shares of the distance between arms.
_OFFSETS = {("paper", 333): -0.3, ("paper", 1000): -0.12, ("ours", 333): 0.12, ("ours", 1000): 0.3}


def search_figure(record: Mapping[str, Any]) -> Figure:
    """A row per finished kind of element, a column per printer: every seed in design and in print."""
    tasks, judges = record["tasks"], (FAB, *MEASURED)
    kinds = made_kinds(tasks)
    figure = new_figure(11, 0.6 + 2.5 * len(kinds))
    panels = figure.subplots(len(kinds), len(judges), squeeze=False, sharex="row", sharey=True)
    for row, kind in zip(panels, kinds, strict=True):
        quantity, sign = next(iter(SHOWN[NAMES[kind]].items()))
        for axes, judge in zip(row, judges, strict=True):
            _draw_panel(axes, tasks, kind, judge)
            axes.set_xlabel(LABELS[quantity])
        row[0].set_yticks(range(len(ARMS)), ARMS)
        row[0].set_ylabel(f"{TITLES[NAMES[kind]]}\n({'more' if sign > 0 else 'less'} is better)")
    for axes, judge in zip(panels[0], judges, strict=True):
        axes.set_title(f"printed by {judge}", fontsize=10)
    panels[0, 0].invert_yaxis()
    _draw_key(figure, panels[0, 0])
    return figure


def _draw_panel(axes: Axes, tasks: Mapping[str, Any], kind: str, judge: str) -> None:
    """All designs of one kind, printed by one printer: rings in design, dots in print."""
    for (search, iterations), offset in _OFFSETS.items():
        task = tasks.get(task_name(kind, search, iterations), {})
        colour, marker = _COLOURS[search], _MARKERS[iterations]
        for run in task.get("of_each_seed", ()):
            if run["judge"] != judge:
                continue
            y = ARMS.index(run["arm"]) + offset
            axes.plot([run["designed"], run["judged"]], [y, y], color=colour, linewidth=0.8, alpha=0.5)
            axes.plot(run["designed"], y, marker, color=colour, markersize=4, markerfacecolor="white")
            axes.plot(run["judged"], y, marker, color=colour, markersize=4)
    # Without a model the image error is ten times that of the others.
    if kind == "computational":
        axes.set_xscale("log")
        axes.set_xticks(ticks := [0.01, 0.02, 0.05, 0.1], [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
    axes.grid(axis="x", color="#d9dee5", linewidth=0.6)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)


def _draw_key(figure: Figure, axes: Axes) -> None:
    for search, iterations in _OFFSETS:
        label = f"{search}, {iterations:,} iterations"
        axes.plot([], [], _MARKERS[iterations], color=_COLOURS[search], markersize=4, label=label)
    axes.plot([], [], "o", color="#555555", markerfacecolor="white", markersize=4, label="in design")
    axes.plot([], [], "o", color="#555555", markersize=4, label="printed")
    figure.legend(loc="outside upper center", ncols=6, frameon=False, fontsize=9)
