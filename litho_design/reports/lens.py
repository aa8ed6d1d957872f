"""The report of one lens."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from litho_data.foundation.report import Page, new_figure
from litho_design.judging.process_window import focus_window
from litho_design.lens.metrics import mtf
from litho_design.optimisation.robust import ProcessWindow
from litho_design.reports.design import add_gauge, add_notes, progress_figure, stroke_advice, stroke_frame
from litho_design.reports.window import add_focus_window, add_yield
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, Design

if TYPE_CHECKING:
    import pandas as pd

    from litho_design.lens.bench import LensBench

LENS_LABELS = {
    "focusing_efficiency": "power within the focusing radius, share of the aperture's",
    "focusing_radius_um": "focusing radius: 3 x ideal FWHM, µm",
    "strehl": "peak over the peak of a perfect lens",
    "mtf_volume_ratio": "volume of the MTF over that of a perfect lens",
    "mtf_half_cutoff": "MTF at half the cut-off NA / wavelength",
    "fwhm_um": "full width at half maximum, µm",
    "fwhm_ideal_um": "the same of a perfect lens, µm",
    "cbr": "centre-to-background ratio",
    "cbr_ceiling": "the same of a perfect lens: the ceiling",
    "eff_window": "power in the PSF window, share of the aperture's",
    "mae_direct": "test objects: MAE of the sensor image, best scale",
    "mae_design": "test objects: MAE, deconvolved with the designed PSF",
    "mae_calibrated": "test objects: MAE, deconvolved with the print's own PSF",
    "mae_calibrated_sd": "its standard deviation over objects and noise seeds",
    "psnr_direct_db": "PSNR of the sensor image, best scale, dB",
    "psnr_design_db": "PSNR with the designed PSF, dB",
    "psnr_calibrated_db": "PSNR with the print's own PSF, dB",
    "ssim_direct": "SSIM of the sensor image",
    "ssim_design": "SSIM with the designed PSF",
    "ssim_calibrated": "SSIM with the print's own PSF",
    "ssim_calibrated_sd": "its standard deviation over objects and noise seeds",
}


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
    figures = design.predicted
    page = Page(
        "Multi-level diffractive lens",
        f"Designed through the printer model “{design.printer.name}”; "
        "every figure is of the printable layout.",
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
    page.table(lens_table(figures), "Scores of the argmax layout", "scores.csv", digits=4)
    if design.reference_efficiency:
        reached = figures["focusing_efficiency"] / design.reference_efficiency
        page.paragraph(
            f"A perfect lens of this aperture puts {100 * design.reference_efficiency:.1f} % within the same "
            f"radius: the print reaches {reached:.2f} of that."
        )
    page.heading("Search")
    page.figure(
        progress_figure(history, design), "Loss of the sampled layout and of the printable (argmax) layout."
    )
    shown = {name: (figures[name], LENS_LABELS[name]) for name in ("strehl", "cbr")}
    add_yield(page, window, ProcessWindow.model_validate(design.settings["window"]), shown)
    add_focus_window(page, focus_window(bench, torch.from_numpy(height).to(bench.aperture.device)))
    page.heading("What the print makes of the levels")
    page.table(
        stroke_frame(design), "Printed height of a uniform field of each level", "levels.csv", digits=3
    )
    page.paragraph(stroke_advice(design))
    add_gauge(page, design)
    page.heading("Settings")
    page.code(design.model_dump_json(indent=1, include={"settings", "printer", "run", "notes"}))
    return page.write(folder)


def lens_table(figures: dict[str, float]) -> pd.DataFrame:
    """One row per figure, with its meaning."""
    import pandas as pd

    rows = [(name, value, LENS_LABELS[name]) for name, value in figures.items()]
    return pd.DataFrame(rows, columns=["name", "value", "meaning"])


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
