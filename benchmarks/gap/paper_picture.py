"""The picture of the paper's own search beside ours: every element in design and in print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from benchmarks.gap.paper_tables import ARMS, FAB, MEASURED, NAMES, SEARCHES, SEEDS_OF, made_kinds
from benchmarks.gap.tables import LABELS, SHOWN, TITLES
from litho_data.foundation.report_pictures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {"paper": "#c2571a", "ours": "#0b6aa2"}
# Lines of one arm, in shares of the distance between arms.
_OFFSETS = {("paper", 333): -0.3, ("paper", 1000): -0.12, ("ours", 333): 0.12, ("ours", 1000): 0.3}


def search_figure(record: Mapping[str, Any]) -> Figure:
    """A row per finished kind of element, a column per printer: every seed in design and in print."""
    tasks, judges = record["tasks"], (FAB, *MEASURED)
    kinds = made_kinds(tasks)
    figure = new_figure(11, 0.6 + 2.5 * len(kinds))
    panels = figure.subplots(len(kinds), len(judges), squeeze=False, sharex="row", sharey=True)
    for row, kind in enumerate(kinds):
        name = NAMES[kind]
        quantity = next(iter(SHOWN[name]))
        for axes, judge in zip(panels[row], judges, strict=True):
            for search in SEARCHES:
                for iterations in SEEDS_OF:
                    seeds = tasks.get(f"{name}-{search}-{iterations}", {}).get("of_each_seed", ())
                    _draw_runs(axes, [run for run in seeds if run["judge"] == judge], search, iterations)
            if kind == "computational":
                axes.set_xscale("log")
                axes.set_xticks(ticks := [0.01, 0.02, 0.05, 0.1], [f"{tick:g}" for tick in ticks])
                axes.minorticks_off()
            axes.grid(axis="x", color="#d9dee5", linewidth=0.6)
            axes.spines[["top", "right", "left"]].set_visible(False)
            axes.tick_params(axis="y", length=0)
            if row == 0:
                axes.set_title(f"printed by {judge}", fontsize=10)
            axes.set_xlabel(LABELS[quantity])
        panels[row, 0].set_yticks(range(len(ARMS)), ARMS)
        better = "more" if SHOWN[name][quantity] > 0 else "less"
        panels[row, 0].set_ylabel(f"{TITLES[name]}\n({better} is better)")
    panels[0, 0].invert_yaxis()
    figure.legend(*_key(panels[0, 0]), loc="outside upper center", ncols=6, frameon=False, fontsize=9)
    return figure


def _draw_runs(axes: Axes, runs: Sequence[Mapping[str, Any]], search: str, iterations: int) -> None:
    colour, marker = _COLOURS[search], "o" if iterations < max(SEEDS_OF) else "D"
    for run in runs:
        y = ARMS.index(run["arm"]) + _OFFSETS[search, iterations]
        axes.plot([run["designed"], run["judged"]], [y, y], color=colour, linewidth=0.8, alpha=0.5)
        axes.plot(run["designed"], y, marker, color=colour, markersize=4, markerfacecolor="white")
        axes.plot(run["judged"], y, marker, color=colour, markersize=4)


def _key(axes: Axes) -> tuple[list[Any], list[str]]:
    """Handles and words of the legend, drawn with nothing in them."""
    words = {
        f"{search}, {iterations:,} iterations": axes.plot(
            [], [], "o" if iterations < max(SEEDS_OF) else "D", color=_COLOURS[search], markersize=4
        )[0]
        for search in SEARCHES
        for iterations in sorted(SEEDS_OF)
    }
    words["in design"] = axes.plot([], [], "o", color="#555555", markerfacecolor="white", markersize=4)[0]
    words["printed"] = axes.plot([], [], "o", color="#555555", markersize=4)[0]
    return list(words.values()), list(words)
