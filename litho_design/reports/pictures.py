"""Draw designs and scores: maps side by side, the curves of a lens, and the loss during a search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from litho_data.reports.pictures import new_figure
from litho_design.tasks.design import Design

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from litho_design.lenses.bench import LensBench

# Upper end of the colour scale, relative to the white of the target. Brighter speckle is clipped.
BRIGHTEST = 1.5
_GREY, _BLUE, _GREEN = "#9aa7b5", "#2f7fd0", "#3a9142"
# Side, in inches, of a map with axes and a colour bar, and of a map without them.
_LARGE, _SMALL = 4.3, 2.4


class Panel(NamedTuple):
    """A map of shape (m, m) to draw, which is ``side_um`` wide. ``colours`` is the name of its matplotlib
    colour map. If ``unit`` is given, a colour bar is drawn.
    """

    title: str
    values: np.ndarray
    side_um: float
    unit: str = ""
    colours: str = "inferno"
    low: float | None = 0.0
    high: float | None = BRIGHTEST


def panels_figure(rows: Sequence[Sequence[Panel]]) -> Figure:
    """Draw panels in rows and columns."""
    columns, side = max(map(len, rows)), _LARGE if rows[0][0].unit else _SMALL
    figure = new_figure(side * columns + 0.6, (side + 0.2) * len(rows))
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for own, row in zip(axes, rows, strict=True):
        for axis, one in zip(own, row, strict=True):
            extent = (0, one.side_um, one.side_um, 0)
            shown = axis.imshow(one.values, cmap=one.colours, vmin=one.low, vmax=one.high, extent=extent)
            axis.set_title(one.title, fontsize=10)
            if one.unit:
                axis.set(xlabel="x, µm", ylabel="y, µm")
                figure.colorbar(shown, ax=axis, label=one.unit, shrink=0.8)
            else:
                axis.set(xticks=[], yticks=[])
    return figure


def progress_figure(history: Sequence[Mapping[str, float]], design: Design) -> Figure:
    """Draw two curves over the iterations of the search: the loss of the sampled layout, and the loss of the
    printable layout.
    """
    figure = new_figure(8, 3.4)
    axis = figure.subplots()
    for name, label, colour in (
        ("sample_loss", "sampled layout", _GREY),
        ("argmax_loss", "printable layout", _BLUE),
    ):
        steps = [entry["iteration"] for entry in history]
        axis.plot(steps, [entry[name] for entry in history], color=colour, label=label)
    axis.axhline(design.polished_loss, color=_GREEN, linewidth=1, label="after polish")
    axis.set(xlabel="iteration", ylabel="loss")
    axis.legend()
    return figure


def decibels(psf: np.ndarray) -> np.ndarray:
    """Convert a PSF to decibels below its peak."""
    return 10 * np.log10(np.maximum(psf, 1e-12) / psf.max())


def lens_curves(height_um: np.ndarray, psf: np.ndarray, bench: LensBench) -> Figure:
    """Draw the central rows of the print, of the PSF and of the MTF, and the same curves for a perfect
    lens.
    """
    import torch

    from litho_design.lenses.score import mtf

    with torch.no_grad():
        ideal_um = bench.ideal_height_um()
        ideal = bench.ideal_psf().cpu().numpy()
    figure = new_figure(13, 3.6)
    profile, spread, transfer = figure.subplots(1, 3)
    middle, row = len(height_um) // 2, len(psf) // 2
    x, cutoff = bench.grid.x_um[middle:], 2 * bench.numerical_aperture / bench.optics.wavelength_um
    frequency = np.arange(row) / bench.window.size_um[0]
    for label, colour, surface, image in (
        ("perfect lens", _GREY, ideal_um.cpu().numpy(), ideal),
        ("print", _BLUE, height_um, psf),
    ):
        profile.plot(x, surface[middle, middle:], color=colour, label=label)
        spread.plot(bench.window.x_um, image[row] / ideal.max(), color=colour, label=label)
        transfer.plot(frequency, mtf(torch.from_numpy(image))[0, :row].numpy(), color=colour, label=label)
    profile.set(xlim=(0, min(30, x[-1])), xlabel="distance from the centre, µm", ylabel="height, µm")
    spread.set(xlim=(-6, 6), xlabel="x, µm", ylabel="PSF over ideal peak")
    transfer.axvline(cutoff, color=_GREY, linewidth=0.8)
    transfer.set(xlim=(0, 1.15 * cutoff), xlabel="cycles/µm", ylabel="MTF")
    for axis in (profile, spread, transfer):
        axis.legend(fontsize=8)
    return figure


def yield_figure(
    draws: Sequence[Mapping[str, float]], figures: Mapping[str, tuple[float, str]], falling: Sequence[str]
) -> Figure:
    """Draw one curve for each score. It shows the share of random prints whose score is at least as good as
    the value on the horizontal axis.

    Args:
        draws: scores of each print, keyed by name.
        figures: dict from the name of each score to be drawn to a pair: the value of this score for the print
            that the model predicts, and its label.
        falling: names of the scores that are better when lower.
    """
    figure = new_figure(8, 3)
    (axes,) = figure.subplots(1, len(figures), sharey=True, squeeze=False)
    for axis, (name, (modelled, label)) in zip(axes, figures.items(), strict=True):
        values = np.sort([draw[name] for draw in draws])
        worse = np.arange(len(values)) / len(values)
        if name in falling:
            axis.step(values, worse + 1 / len(values), where="post")
        else:
            axis.step(values, 1 - worse, where="pre")
        axis.axvline(modelled, color="0.5", linestyle="--", linewidth=1)
        axis.set_xlabel(label)
    axes[0].set_ylabel("yield")
    return figure
