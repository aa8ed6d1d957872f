"""Write a report with the statistics of a set of layouts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation import Array
from litho_data.layouts.statistics import LayoutStatistics
from litho_data.reports.page import Page
from litho_data.reports.pictures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN = 4
# Lower limit of the logarithmic axes. Shares below this limit are nothing but rounding errors.
_LEAST_SHARE = 1e-6


def statistics_page(statistics: LayoutStatistics, files: Sequence[Path]) -> Page:
    """Make a page with pictures of the first layouts, the shares of the levels, the shares of the jumps
    between neighbouring pixels, and the spectrum.
    """
    from litho_data.readers import read_layout

    page = Page(
        f"{statistics.count} layouts", f"{statistics.levels} levels, pitch {statistics.pitch_um:g} µm"
    )
    page.verdict(_verdict(statistics))
    first = {file.stem: read_layout(file) for file in files[:_SHOWN]}
    page.figure(layouts_figure(first, (0, statistics.levels - 1)), "The first layouts, coloured by level.")

    graphs = new_figure(11, 3)
    levels = np.arange(statistics.levels)
    of_levels, of_jumps, of_power = graphs.subplots(1, 3)
    of_levels.bar(levels, statistics.level_share)
    of_levels.set(xlabel="level", ylabel="share of pixels")
    shares = {"yscale": "log", "ylim": (_LEAST_SHARE, 1.5)}
    of_jumps.bar(levels, statistics.jump_share)
    of_jumps.set(xlabel="jump between neighbours, levels", ylabel="share of pairs", **shares)
    of_power.step(statistics.frequency_per_um, statistics.power_share, where="mid")
    of_power.set(xlabel="spatial frequency, cycles/µm", ylabel="share of power", **shares)
    page.figure(
        graphs,
        "All layouts together: shares of the levels, jumps between neighbouring pixels, and power spectrum.",
    )
    page.heading("In numbers", folded=True)
    numbers = {
        "level or jump": levels,
        "share of pixels": statistics.level_share,
        "share of pairs": statistics.jump_share,
    }
    page.table(
        numbers,
        "Share of pixels at each level, and share of neighbouring pairs with each jump between levels.",
        "levels.csv",
        digits=4,
    )
    return page


def layouts_figure(levels: Mapping[str, Array], between: tuple[int, int]) -> Figure:
    """Draw layouts side by side, each an array of shape (ny, nx). The keys of ``levels`` are the titles, and
    all layouts have the same colour scale.
    """
    figure = new_figure(11, 3)
    for place, (title, level) in enumerate(levels.items(), start=1):
        axes = figure.add_subplot(1, len(levels), place)
        axes.imshow(level, vmin=between[0], vmax=between[1], cmap="viridis")
        axes.set_title(title)
        axes.set_axis_off()
    return figure


def _verdict(statistics: LayoutStatistics) -> str:
    used = int(np.count_nonzero(np.asarray(statistics.level_share)))
    jump = int(np.flatnonzero(np.asarray(statistics.jump_share)).max())
    flat = 100 * float(statistics.jump_share[0])
    levels = "Every level is" if used == statistics.levels else f"{used} of {statistics.levels} levels are"
    return (
        f"{levels} used. Neighbouring pixels differ by at most {jump} level{'' if jump == 1 else 's'}; "
        f"{flat:.0f} % of neighbouring pairs have the same level."
    )
