"""The part of a report that only lenses have: profiles, MTF, focus and gain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from litho_data.reports.page import Page
from litho_data.reports.pictures import new_figure
from litho_design.lenses.bench import LensBench
from litho_design.lenses.score import mtf
from litho_design.tasks.design import Design

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def decibels(psf: np.ndarray) -> np.ndarray:
    """A PSF in decibels below its peak."""
    return 10 * np.log10(np.maximum(psf, 1e-12) / psf.max())


def add_lens_curves(
    page: Page, design: Design, height: np.ndarray, psf: np.ndarray, bench: LensBench
) -> None:
    """Print along the central row, PSF and MTF beside those of a perfect lens."""
    with torch.no_grad():
        ideal = bench(bench.ideal_height_um()).cpu().numpy()
    page.figure(
        _curves(design, height, psf, ideal, bench), "Print along the central row, PSF profile, and MTF."
    )


def _curves(
    design: Design, height: np.ndarray, psf: np.ndarray, ideal: np.ndarray, bench: LensBench
) -> Figure:
    figure = new_figure(13, 3.6)
    axes = figure.subplots(1, 3)
    middle = height.shape[0] // 2
    x = bench.grid.x_um[middle:]
    axes[0].plot(x, height[middle, middle:], label="print")
    wanted = bench.ideal_height_um().cpu().numpy()[middle, middle:]
    axes[0].plot(x, wanted, color="#9aa7b5", linewidth=0.8, label="perfect lens", zorder=0)
    axes[0].set(xlim=(0, min(30, x[-1])), xlabel="distance from the centre, µm", ylabel="height, µm")
    across = bench.window.x_um
    row = psf.shape[0] // 2
    axes[1].plot(across, ideal[row] / ideal.max(), color="#9aa7b5", label="perfect lens")
    axes[1].plot(across, psf[row] / ideal.max(), label="print")
    axes[1].set(xlim=(-6, 6), xlabel="x, µm", ylabel="PSF over ideal peak")
    frequency = np.arange(psf.shape[0] // 2) / (psf.shape[0] * design.layout.pitch_um)
    for image, label, colour in ((ideal, "perfect lens", "#9aa7b5"), (psf, "print", "C0")):
        curve = mtf(torch.from_numpy(image))[0, : len(frequency)].numpy()
        axes[2].plot(frequency, curve, label=label, color=colour)
    cutoff = 2 * bench.numerical_aperture / design.optics.wavelength_um
    axes[2].axvline(cutoff, color="#9aa7b5", linewidth=0.8)
    axes[2].set(xlim=(0, 1.15 * cutoff), xlabel="cycles/µm", ylabel="MTF")
    for axis in axes:
        axis.legend(fontsize=8)
    return figure
