"""Draw the plots of the evaluation and benchmark reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.reports.pictures import LIGHT, model_colour, new_figure
from litho_data.store import PrintedScan
from litho_models.scoring.records import ModelScores

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER_MAE_NM = 24.35
_RESIDUAL_RANGE_NM = 80.0
# A function that receives the scores of one model and returns a list of x values, followed by one or two
# lists of y values.
Lines = Callable[[Any], Sequence[Sequence[float | None]]]


def error_bars(scores: Sequence[ModelScores], floor_nm: float | None, paper_line: bool) -> Figure:
    """Draw two errors of each model with their confidence intervals. One is the error with nothing fitted to
    the scans, and the other is the error after terms are fitted to each scan. Lines mark the noise floor and
    the error reported in the paper.
    """
    figure = new_figure(8.5, 0.55 * len(scores) + 2.0)
    axes = figure.subplots()
    position = np.arange(len(scores))
    colours = [model_colour(s.model) for s in scores]
    bars = [
        (-0.17, "nothing fitted", 0.4, "mae_abs"),
        (0.17, "each scan's own terms fitted", 1.0, "leading"),
    ]
    if scores[0].seen_by == "sem":
        bars, floor_nm = [(0.0, "distance between predicted and measured edges", 1.0, "leading")], None
    for shift, label, strength, error in bars:
        means = np.array([getattr(s, f"{error}_nm") for s in scores])
        axes.barh(position + shift, means, 0.32, color=colours, alpha=strength)
        axes.fill_between([], [], color="#868d98", alpha=strength, label=label)
        ends = [getattr(s, f"{error}_ci95_nm") or (mean, mean) for s, mean in zip(scores, means, strict=True)]
        axes.errorbar(
            means,
            position + shift,
            xerr=np.abs(np.transpose(ends) - means),
            fmt="none",
            ecolor=LIGHT["ink"],
            capsize=3,
            lw=1,
        )
    if floor_nm is not None:
        axes.axvline(floor_nm, color="#2d8a4e", ls="--", label=f"noise floor: {floor_nm:.1f} nm")
    if paper_line:
        axes.axvline(
            PAPER_MAE_NM, color="#c23b22", ls=":", label=f"paper, PBL: {PAPER_MAE_NM} nm (other protocol)"
        )
    axes.set_yticks(position, [s.model for s in scores])
    axes.invert_yaxis()
    axes.set_xlabel("mean error over scans, nm (error bars: 95 % confidence interval)")
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    axes.grid(axis="x", alpha=0.3)
    return figure


def residual_maps(scan: PrintedScan, residuals_um: Mapping[str, np.ndarray]) -> Figure:
    """Draw the measured height of one scan and the residual map of each model. A residual is the measured
    minus the predicted height, after the terms fitted to the scan are removed.
    """
    panels = len(residuals_um) + 1
    columns = min(4, panels)
    rows = -(-panels // columns)
    # Leave space for two colour scales beside the panels.
    figure = new_figure(2.7 * columns + 1.8, 2.9 * rows)
    first, *others = figure.subplots(rows, columns, squeeze=False).flat
    extent = (0, scan.shape[1] * scan.pitch_um, scan.shape[0] * scan.pitch_um, 0)
    image = first.imshow(scan.height_um, extent=extent, cmap="viridis")
    first.set_title(f"{scan.id}: measured, µm", fontsize=9)
    first.set(xlabel="x, µm", ylabel="y, µm")
    figure.colorbar(image, ax=first, shrink=0.6)
    for axes, (name, residual) in zip(others, residuals_um.items(), strict=False):
        error = NM_PER_UM * residual
        image = axes.imshow(
            error, extent=extent, cmap="RdBu_r", vmin=-_RESIDUAL_RANGE_NM, vmax=_RESIDUAL_RANGE_NM
        )
        axes.set_title(f"{name}: {np.nanmean(np.abs(error)):.1f} nm", fontsize=9)
        axes.set_xlabel("x, µm", fontsize=9)
        axes.tick_params(labelleft=False)
    figure.colorbar(image, ax=others[: panels - 1], shrink=0.6, label="measured − predicted, nm")
    for axes in others[panels - 1 :]:
        axes.set_axis_off()
    return figure


def line_profiles(scan: PrintedScan, residuals_um: Mapping[str, np.ndarray]) -> Figure:
    """Draw profiles along the middle row of one scan: the layout, the measured height, and the prediction of
    each model. The terms that were fitted to the scan are added to each prediction.
    """
    figure = new_figure(10, 3.4)
    axes = figure.subplots()
    row = scan.shape[0] // 2
    x_um = (np.arange(scan.shape[1]) + 0.5) * scan.pitch_um
    axes.step(x_um, scan.layout_um[row], where="mid", color="#c9d1da", lw=1, label="layout")
    axes.plot(x_um, scan.height_um[row], color=LIGHT["ink"], lw=1.4, label="measured")
    for name, residual in residuals_um.items():
        axes.plot(x_um, scan.height_um[row] - residual[row], lw=1, color=model_colour(name), label=name)
    axes.set(xlabel="x, µm", ylabel="height, µm", xlim=(0, min(x_um[-1], 30)))
    axes.legend(ncols=4, fontsize=8)
    return figure


def level_bias(scores: Sequence[ModelScores]) -> Figure:
    """Draw the mean (bias) and the standard deviation of the datum-free error for each layout level."""

    def of(name: str) -> Lines:
        return lambda score: [[getattr(one, key) for one in score.by_level] for key in ("level", name)]

    panels = {"bias (measured - predicted), nm": of("bias_nm"), "standard deviation, nm": of("sd_nm")}
    return _curves(scores, "layout level", panels)


def transfer(scores: Sequence[ModelScores]) -> Figure:
    """Draw the transfer function of each model, its coherence with the measured height, and the power
    spectral density of its error, all against spatial frequency, along x (solid lines) and y (dashed lines).
    """

    def of(name: str) -> Lines:
        return lambda score: [
            getattr(score.transfer, key) for key in ("frequency_per_um", f"{name}_x", f"{name}_y")
        ]

    panels = {
        "predicted over measured": of("gain"),
        "coherence γ²": of("coherence"),
        "error, nm² per cycle/µm": of("error_psd"),
    }
    figure = _curves(scores, "spatial frequency, 1/µm (solid x, dashed y)", panels)
    figure.axes[0].set_ylim(0, 2)
    figure.axes[2].set_yscale("log")
    return figure


def _curves(rows: Sequence[Any], x_label: str, panels: Mapping[str, Lines]) -> Figure:
    """Draw one panel for each label. A panel shows one solid line per model. ``panels`` contains a function
    for each label. If this function returns a second list of y values, a dashed line shows these values.
    """
    figure = new_figure(max(8.5, 4.2 * len(panels)), 3.4)
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (label, lines) in zip(grid, panels.items(), strict=True):
        for row in rows:
            x, *found = lines(row)
            for y, dashes in zip(found, ("-", "--"), strict=False):
                axes.plot(x, np.array(y, float), dashes, color=model_colour(row.model), lw=1, label=row.model)
        axes.set(xlabel=x_label, ylabel=label)
    handles, names = grid[0].get_legend_handles_labels()
    named = dict(zip(names, handles, strict=True))
    grid[0].legend(named.values(), named, fontsize=8)
    return figure
