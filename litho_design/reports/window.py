"""Figures of the process window: yield curves, and a lens through focus and gain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation.report import Page, new_figure
from litho_design.optimisation.robust import ProcessWindow

if TYPE_CHECKING:
    from litho_design.judging.process_window import FocusWindow


def add_yield(
    page: Page, draws: list[dict[str, float]], window: ProcessWindow, figures: dict[str, tuple[float, str]]
) -> None:
    """Yield curves of a design.

    Args:
        draws: figures of single prints on single benches.
        window: the spreads that were drawn from.
        figures: name to value of the print as modelled, and label.
    """
    import pandas as pd

    page.heading("Process window")
    designed = "in the loss" if window.samples else "not in the loss: designed for the print as modelled"
    page.paragraph(
        f"{len(draws)} prints drawn from gain ±{100 * window.gain_sd:.1f} %, extra blur of scale "
        f"{window.blur_sd_um:g} µm, defocus ±{window.defocus_sd_um:g} µm and wavelength "
        f"±{1000 * window.wavelength_sd_um:g} nm (standard deviations; the window was {designed}; these "
        "draws were in no search): the share of them that is at least as good as the abscissa."
    )
    figure = new_figure(8, 3)
    axes = figure.subplots(1, len(figures), sharey=True)
    for axis, (name, (modelled, label)) in zip(axes, figures.items(), strict=True):
        values = np.sort([draw[name] for draw in draws])
        axis.step(values, 1 - np.arange(len(values)) / len(values), where="pre")
        axis.axvline(modelled, color="0.5", linestyle="--", linewidth=1)
        axis.set_xlabel(label)
    axes[0].set_ylabel("yield")
    page.figure(figure, "Yield curves; the dashed line is the print as modelled.")
    page.table(pd.DataFrame(draws), "Single draws", "window.csv", digits=3)


def add_focus_window(page: Page, window: FocusWindow) -> None:
    """Bossung curves of FWHM and peak, and the map of the peak."""
    import pandas as pd

    page.paragraph(
        f"Through focus and print gain (gain stands for dose): the peak keeps 80 % of its best value over "
        f"{window.depth_of_focus_um:.1f} µm of defocus at the modelled gain, and over a gain range of "
        f"{window.gain_latitude:.2f} in focus; the ends of the sweep cut both."
    )
    strehl, width = np.array(window.strehl), np.array(window.fwhm_um)
    figure = new_figure(13, 3.6)
    axes = figure.subplots(1, 3)
    for row, gain in enumerate(window.gain):
        for axis, values in ((axes[0], width), (axes[1], strehl)):
            axis.plot(window.defocus_um, values[row], marker="o", markersize=3, label=f"gain {gain:g}")
    axes[0].set_ylabel("FWHM, µm")
    axes[1].set_ylabel("peak over that of a perfect lens")
    axes[1].legend(fontsize=8)
    share = strehl / strehl.max()
    shown = axes[2].contourf(window.defocus_um, window.gain, share, levels=np.linspace(0, 1, 11))
    axes[2].contour(window.defocus_um, window.gain, share, levels=[0.8], colors="white")
    axes[2].set_ylabel("print gain over the modelled one")
    figure.colorbar(shown, ax=axes[2], label="peak over the best of the sweep")
    for axis in axes:
        axis.set_xlabel("defocus, µm")
    page.figure(figure, "Left and middle: one curve per gain. Right: the window, its 80 % line in white.")
    rows = [
        {"gain": gain, "defocus_um": shift, "strehl": strehl[row, column], "fwhm_um": width[row, column]}
        for row, gain in enumerate(window.gain)
        for column, shift in enumerate(window.defocus_um)
    ]
    page.table(pd.DataFrame(rows), "Sweep", "focus_window.csv", digits=3)
