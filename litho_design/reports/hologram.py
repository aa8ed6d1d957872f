"""The report of one hologram."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.report import Page, new_figure
from litho_design.holograms.bench import HologramScore
from litho_design.optimisation.process_window import ProcessWindow
from litho_design.reports.advice import black_ssim, stroke_advice
from litho_design.reports.parts import (
    add_gauge,
    add_notes,
    add_scores,
    add_yield,
    level_table,
    meanings,
    progress_figure,
)
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, TARGET_FILE, Design


def write_hologram_report(
    folder: Path, design: Design, history: list[dict[str, float]], window: list[dict[str, float]]
) -> Path:
    """Write ``report.html`` and its CSV tables from the arrays in ``folder``."""
    levels, height_um, image, target = (
        np.load(folder / name) for name in (LEVELS_FILE, HEIGHT_FILE, IMAGE_FILE, TARGET_FILE)
    )
    score, labels = HologramScore.model_validate(design.predicted), meanings(HologramScore)
    page = Page(
        "Holographic element",
        f"Designed through the printer model “{design.printer.name}”; "
        "all scores are of the printable layout.",
    )
    page.tiles(
        [
            (f"{100 * score.eff_signal:.1f} %", "of the incident light on the signal"),
            (f"{score.si_psnr_db:.1f} dB", "scale-invariant PSNR"),
            (f"{score.ssim:.3f}", f"SSIM (black image {black_ssim(design):.3f})"),
            (f"{score.speckle_contrast:.2f}", "speckle contrast"),
            (f"{design.stroke.stroke_waves:.2f} waves", "printed stroke"),
        ]
    )
    add_notes(page, design)
    page.heading("Layout, print and image")
    page.figure(
        _pictures(design, levels, height_um, image, target), "Rows are y (down), columns x; lengths in µm."
    )
    add_scores(page, design, labels)
    if design.reference_efficiency:
        page.paragraph(
            f"A continuous phase that cares for nothing but power puts "
            f"{100 * design.reference_efficiency:.1f} % on the signal; the print reaches "
            f"{score.eff_signal / design.reference_efficiency:.2f} of that."
        )
    page.heading("Search")
    page.figure(
        progress_figure(history, design), "Loss of the sampled layout and of the printable (argmax) layout."
    )
    page.paragraph(
        f"Argmax loss {design.start_loss:.4f} at the start, {design.argmax_loss:.4f} after "
        f"{design.iterations} iterations, {design.polished_loss:.4f} after the polish; the last sample had "
        f"{design.sample_loss:.4f} (soft-to-hard gap {design.argmax_loss - design.sample_loss:+.4f})."
    )
    shown = {name: (getattr(score, name), labels[name]) for name in ("si_psnr_db", "eff_signal")}
    add_yield(page, window, ProcessWindow.model_validate(design.settings["window"]), shown)
    page.heading("Printed height of the levels")
    page.table(level_table(design), "Printed height of a uniform field of each level", "levels.csv", digits=3)
    page.paragraph(stroke_advice(design))
    add_gauge(page, design)
    page.heading("Settings")
    page.code(design.model_dump_json(indent=1, include={"settings", "printer", "target", "run", "notes"}))
    return page.write(folder)


def _pictures(
    design: Design, levels: np.ndarray, height_um: np.ndarray, image: np.ndarray, target: np.ndarray
):
    figure = new_figure(11, 8.6)
    axes = figure.subplots(2, 2)
    side = design.layout.size_um
    extent = (0, side, side, 0)
    scaled = (image * target).sum() / (image**2).sum() * image
    for axis, array, title, colours, limits, unit in (
        (axes[0, 0], levels, "layout", "viridis", (0, design.layout.levels - 1), "level"),
        (
            axes[0, 1],
            height_um,
            f"print predicted by {design.printer.name}",
            "viridis",
            (None, None),
            "height, µm",
        ),
        (axes[1, 0], target, "wanted image", "inferno", (0, 1), "intensity"),
        (
            axes[1, 1],
            scaled,
            "image behind the predicted print",
            "inferno",
            (0, 1.5),
            "intensity, matched scale",
        ),
    ):
        shown = axis.imshow(
            array, cmap=colours, vmin=limits[0], vmax=limits[1], extent=extent, interpolation="nearest"
        )
        axis.set_title(title)
        axis.set_xlabel("x, µm")
        axis.set_ylabel("y, µm")
        figure.colorbar(shown, ax=axis, label=unit, shrink=0.85)
    return figure
