"""The report of one lens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from litho_data.foundation.report import Page, new_figure
from litho_design.lenses.bench import LensBench
from litho_design.lenses.focus_window import FocusWindow, focus_window
from litho_design.lenses.score import ImagingLensScore, mtf
from litho_design.optimisation.process_window import ProcessWindow
from litho_design.reports.advice import stroke_advice
from litho_design.reports.parts import (
    add_gauge,
    add_notes,
    add_scores,
    add_yield,
    level_table,
    meanings,
    progress_figure,
)
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, Design


def write_lens_report(
    folder: Path,
    design: Design,
    history: list[dict[str, float]],
    bench: LensBench,
    window: list[dict[str, float]],
) -> Path:
    """Write ``report.html`` and its CSV tables from the arrays in ``folder``."""
    levels, height, psf = (np.load(folder / name) for name in (LEVELS_FILE, HEIGHT_FILE, IMAGE_FILE))
    with torch.no_grad():
        ideal = bench(bench.ideal_height_um()).cpu().numpy()
    figures, labels = design.predicted, meanings(ImagingLensScore)
    page = Page(
        "Multi-level diffractive lens",
        f"Designed through the printer model “{design.printer.name}”; "
        "all scores are of the printable layout.",
    )
    page.tiles(
        [
            (f"{100 * figures['focusing_efficiency']:.1f} %", "of the light in the focus"),
            (f"{figures['strehl']:.3f}", "Strehl ratio"),
            (f"{figures['fwhm_um']:.2f} µm", f"FWHM (ideal {figures['fwhm_ideal_um']:.2f} µm)"),
            (f"{figures['cbr']:.0f}", f"centre to background (ceiling {figures['cbr_ceiling']:.0f})"),
        ]
    )
    add_notes(page, design)
    page.heading("Layout, print and focus")
    page.figure(
        _pictures(design, levels, height, psf), "Layout, predicted print, and PSF (decibels below its peak)."
    )
    page.figure(
        _curves(design, height, psf, ideal, bench), "Print along the central row, PSF profile, and MTF."
    )
    add_scores(page, design, labels)
    if design.reference_efficiency:
        reached = figures["focusing_efficiency"] / design.reference_efficiency
        page.paragraph(
            f"A perfect lens of this aperture puts {100 * design.reference_efficiency:.1f} % within the same "
            f"radius; the print reaches {reached:.2f} of that."
        )
    page.heading("Search")
    page.figure(
        progress_figure(history, design), "Loss of the sampled layout and of the printable (argmax) layout."
    )
    shown = {name: (figures[name], labels[name]) for name in ("strehl", "cbr")}
    add_yield(page, window, ProcessWindow.model_validate(design.settings["window"]), shown)
    _add_focus_window(page, focus_window(bench, torch.from_numpy(height).to(bench.aperture.device)))
    page.heading("Printed height of the levels")
    page.table(level_table(design), "Printed height of a uniform field of each level", "levels.csv", digits=3)
    page.paragraph(stroke_advice(design))
    add_gauge(page, design)
    page.heading("Settings")
    page.code(design.model_dump_json(indent=1, include={"settings", "printer", "run", "notes"}))
    return page.write(folder)


def _pictures(design: Design, levels: np.ndarray, height: np.ndarray, psf: np.ndarray):
    figure = new_figure(13, 4.2)
    axes = figure.subplots(1, 3)
    side, window = design.layout.size_um, psf.shape[0] * design.layout.pitch_um
    decibel = 10 * np.log10(np.maximum(psf, 1e-12) / psf.max())
    for axis, array, title, colours, limits, unit, extent in (
        (axes[0], levels, "layout", "viridis", (0, design.layout.levels - 1), "level", side),
        (axes[1], height, f"print predicted by {design.printer.name}", "viridis", (None, None), "µm", side),
        (axes[2], decibel, "PSF", "inferno", (-40, 0), "dB", window),
    ):
        shown = axis.imshow(
            array, cmap=colours, vmin=limits[0], vmax=limits[1], extent=(0, extent, extent, 0)
        )
        axis.set_title(title)
        axis.set_xlabel("x, µm")
        axis.set_ylabel("y, µm")
        figure.colorbar(shown, ax=axis, label=unit, shrink=0.8)
    return figure


def _curves(design: Design, height: np.ndarray, psf: np.ndarray, ideal: np.ndarray, bench: LensBench):
    figure = new_figure(13, 3.6)
    axes = figure.subplots(1, 3)
    middle = height.shape[0] // 2
    x = bench.grid.x_um[middle:]
    axes[0].plot(x, height[middle, middle:], label="print")
    wanted = bench.ideal_height_um().cpu().numpy()[middle, middle:]
    axes[0].plot(x, wanted, color="0.7", linewidth=0.8, label="perfect lens", zorder=0)
    axes[0].set_xlim(0, min(30, x[-1]))
    axes[0].set_xlabel("distance from the centre, µm")
    axes[0].set_ylabel("height, µm")
    across = bench.window.x_um
    row = psf.shape[0] // 2
    axes[1].plot(across, ideal[row] / ideal.max(), color="0.6", label="perfect lens")
    axes[1].plot(across, psf[row] / ideal.max(), label="print")
    axes[1].set_xlim(-6, 6)
    axes[1].set_xlabel("x, µm")
    axes[1].set_ylabel("PSF over ideal peak")
    frequency = np.arange(psf.shape[0] // 2) / (psf.shape[0] * design.layout.pitch_um)
    for image, label, colour in ((ideal, "perfect lens", "0.6"), (psf, "print", "C0")):
        curve = mtf(torch.from_numpy(image))[0, : len(frequency)].numpy()
        axes[2].plot(frequency, curve, label=label, color=colour)
    cutoff = 2 * bench.numerical_aperture / design.optics.wavelength_um
    axes[2].axvline(cutoff, color="0.8", linewidth=0.8)
    axes[2].set_xlim(0, 1.15 * cutoff)
    axes[2].set_xlabel("cycles/µm")
    axes[2].set_ylabel("MTF")
    for axis in axes:
        axis.legend(fontsize=8)
    return figure


def _add_focus_window(page: Page, window: FocusWindow) -> None:
    """Bossung curves of FWHM and peak, and the map of the peak."""
    import pandas as pd

    page.paragraph(
        "Focus and print gain (which represents the dose) are swept. The peak stays above 80 % of its best "
        f"value over {window.depth_of_focus_um:.1f} µm of defocus at the modelled gain and over a gain range "
        f"of {window.gain_latitude:.2f} in focus; both ranges end with the sweep."
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
