"""Plots of the evaluation and benchmark reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.reports.pictures import LIGHT, model_colour, new_figure
from litho_data.store import PrintedScan
from litho_models.scan_terms import NuisanceProtocol, cross_fit, policy_terms
from litho_models.scoring.records import ModelScores

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from litho_models.evaluation.fit_cache import FitRecord

PAPER_MAE_NM = 24.35
_RESIDUAL_RANGE_NM = 80.0
# 95 % quantile of chi² with two degrees of freedom.
_CHI2_95_OF_2 = 5.991


def error_bars(scores: Sequence[ModelScores], floor_nm: float | None, paper_line: bool) -> Figure:
    """Both headline errors of each model with their intervals over scans, the noise floor and the paper."""
    figure = new_figure(8.5, 0.55 * len(scores) + 2.0)
    axes = figure.subplots()
    position = np.arange(len(scores))
    colours = [model_colour(s.model) for s in scores]
    bars = [
        (-0.17, "nothing fitted", 0.4, "mae_abs"),
        (0.17, "own terms of each scan fitted", 1.0, "leading"),
    ]
    if scores[0].seen_by == "sem":
        bars, floor_nm = [(0.0, "distance of predicted from measured edges", 1.0, "leading")], None
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
    axes.set_xlabel("error over scans, nm (bars: 95 % interval over scans)")
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    axes.grid(axis="x", alpha=0.3)
    return figure


def residual_maps(
    scan: PrintedScan, predictions_um: Mapping[str, np.ndarray], protocol: NuisanceProtocol
) -> Figure:
    """Measured height of one scan and, per model, measured minus predicted, freed of its nuisances."""
    panels = len(predictions_um) + 1
    columns = min(4, panels)
    rows = -(-panels // columns)
    # Beside the panels, two scales.
    figure = new_figure(2.7 * columns + 1.8, 2.9 * rows)
    grid = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    extent = (0, scan.shape[1] * scan.pitch_um, scan.shape[0] * scan.pitch_um, 0)
    image = grid[0].imshow(scan.height_um, extent=extent, cmap="viridis")
    grid[0].set_title(f"{scan.id}: measured, µm", fontsize=9)
    grid[0].set(xlabel="x, µm", ylabel="y, µm")
    figure.colorbar(image, ax=grid[0], shrink=0.6)
    for axes, (name, prediction) in zip(grid[1:], predictions_um.items(), strict=False):
        error = NM_PER_UM * residual_um(scan, prediction, protocol)
        image = axes.imshow(
            error, extent=extent, cmap="RdBu_r", vmin=-_RESIDUAL_RANGE_NM, vmax=_RESIDUAL_RANGE_NM
        )
        axes.set_title(f"{name}: {np.nanmean(np.abs(error)):.1f} nm", fontsize=9)
        axes.set_xlabel("x, µm", fontsize=9)
        axes.tick_params(labelleft=False)
    if panels > 1:
        figure.colorbar(image, ax=grid[1:panels].tolist(), shrink=0.6, label="measured − predicted, nm")
    for axes in grid[panels:]:
        axes.set_axis_off()
    return figure


def line_profiles(
    scan: PrintedScan, predictions_um: Mapping[str, np.ndarray], protocol: NuisanceProtocol
) -> Figure:
    """The middle row of one scan: layout, measurement, and the models with the scan's nuisances added."""
    figure = new_figure(10, 3.4)
    axes = figure.subplots()
    row = scan.shape[0] // 2
    x_um = (np.arange(scan.shape[1]) + 0.5) * scan.pitch_um
    axes.step(x_um, scan.layout_um[row], where="mid", color="#c9d1da", lw=1, label="layout")
    axes.plot(x_um, scan.height_um[row], color=LIGHT["ink"], lw=1.4, label="measured")
    for name, prediction in predictions_um.items():
        matched = scan.height_um[row] - residual_um(scan, prediction, protocol)[row]
        axes.plot(x_um, matched, lw=1, color=model_colour(name), label=name)
    axes.set(xlabel="x, µm", ylabel="height, µm", xlim=(0, min(x_um[-1], 30)))
    axes.legend(ncols=4, fontsize=8)
    return figure


def level_bias(scores: Sequence[ModelScores]) -> Figure:
    """Bias and spread of the datum-free error per printed level."""
    figure = new_figure(9, 3.4)
    left, right = figure.subplots(1, 2)
    for score in scores:
        levels = [entry.level for entry in score.by_level]
        style: dict[str, Any] = {"marker": "o", "ms": 3, "lw": 1, "color": model_colour(score.model)}
        left.plot(levels, [entry.bias_nm for entry in score.by_level], label=score.model, **style)
        right.plot(levels, [entry.sd_nm for entry in score.by_level], **style)
    left.axhline(0, color="#9aa7b5", lw=0.8)
    left.set_ylabel("bias (measured - predicted), nm")
    right.set_ylabel("standard deviation, nm")
    for axes in (left, right):
        axes.set_xlabel("layout level")
    left.legend(fontsize=8)
    return figure


def transfer(scores: Sequence[ModelScores]) -> Figure:
    """Transfer, coherence and error density against spatial frequency, along x (solid) and y (dashed)."""
    figure = new_figure(12, 3.4)
    panels = figure.subplots(1, 3)
    for score in scores:
        curves, colour = score.transfer, model_colour(score.model)
        for axes, name in zip(panels, ("gain", "coherence", "error_psd"), strict=True):
            along_x, along_y = getattr(curves, f"{name}_x"), getattr(curves, f"{name}_y")
            axes.plot(curves.frequency_per_um, along_x, color=colour, lw=1.2, label=score.model)
            axes.plot(curves.frequency_per_um, along_y, color=colour, lw=1, ls="--")
    left, middle, right = panels
    left.axhline(1, color="#9aa7b5", lw=0.8)
    left.set(ylim=(0, 2), ylabel="predicted over measured")
    middle.set_ylabel("coherence γ²")
    right.set(yscale="log", ylabel="error, nm² per cycle/µm")
    for axes in panels:
        axes.set_xlabel("spatial frequency, 1/µm (solid x, dashed y)")
    left.legend(fontsize=8)
    return figure


def loss_curves(fits: Sequence[FitRecord]) -> Figure:
    """Training error (solid) and inner-validation error (dashed) of every fit with rounds."""
    figure = new_figure(8.5, 3.4)
    axes = figure.subplots()
    named: set[str] = set()
    for fit in fits:
        colour = model_colour(fit.model)
        label = None if fit.model in named else fit.model
        named.add(fit.model)
        axes.plot(fit.steps, fit.training_mae_nm, color=colour, lw=1.2, label=label)
        validation = [np.nan if value is None else value for value in fit.validation_mae_datum_free_nm]
        axes.plot(fit.steps, validation, color=colour, lw=1, ls="--")
    axes.set(
        xlabel="optimiser steps",
        ylabel="MAE, nm (solid: training, nuisances out;\ndashed: inner validation, datum-free)",
    )
    axes.legend(fontsize=8)
    return figure


def residual_um(scan: PrintedScan, prediction_um: np.ndarray, protocol: NuisanceProtocol) -> np.ndarray:
    """Cross-fitted residual of one scan under the protocol, µm."""
    terms = policy_terms(protocol.policy)
    return cross_fit(scan.height_um, prediction_um, scan.valid, terms, protocol.blocks).residual_um


def print_gains(score: ModelScores) -> Figure:
    """Gain and offset of every print against a model's prediction, with 95 % ellipses, coloured by print."""
    from matplotlib.patches import Ellipse

    figure = new_figure(7.0, 5.0)
    axes = figure.subplots()
    prints = sorted({row.print for row in score.scans})
    for number, name in enumerate(prints):
        colour = f"C{number % 10}"
        placed = [
            (row.slope, row.intercept_nm, row.line_covariance)
            for row in score.scans
            if row.print == name and row.slope is not None
        ]
        axes.plot([gain for gain, _, _ in placed], [at for _, at, _ in placed], ".", color=colour, label=name)
        for gain, offset_nm, covariance in placed:
            if covariance is None:
                continue
            variances, directions = np.linalg.eigh(covariance)
            minor, major = 2 * np.sqrt(_CHI2_95_OF_2 * variances.clip(0))
            angle = float(np.degrees(np.arctan2(directions[1, 1], directions[0, 1])))
            axes.add_patch(Ellipse((gain, offset_nm), major, minor, angle=angle, fill=False, color=colour))
    axes.axvline(1.0, color="#9aa7b5", lw=0.8)
    axes.axhline(0.0, color="#9aa7b5", lw=0.8)
    axes.set(
        xlabel=f"gain: measured height per height predicted by {score.model}",
        ylabel="offset at predicted height zero, nm",
    )
    axes.legend(title="print", fontsize=8)
    return figure
