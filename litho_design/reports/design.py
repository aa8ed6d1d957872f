"""The report of one design, whatever its task."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.reports.page import Page, capitalised
from litho_data.reports.pictures import new_figure
from litho_design.holograms.task import HologramTask
from litho_design.lenses.task import LensTask
from litho_design.optimisation.process_window import measure_yield
from litho_design.reliefs.task import UNPRINTABLE_FILE, ReliefTask
from litho_design.reports.advice import WORDS, baseline_line, headline, named, stroke_advice, width_sentence
from litho_design.reports.lens import add_lens_curves, decibels
from litho_design.reports.parts import (
    BRIGHTEST,
    add_gauge,
    add_notes,
    add_scores,
    add_yield,
    identity,
    level_table,
    meanings,
    progress_figure,
)
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, TARGET_FILE, Design
from litho_design.tasks.task import Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TITLES = {
    "hoe": "Holographic element",
    "lens-direct": "Multi-level diffractive lens",
    "lens-computational": "Multi-level diffractive lens with deconvolution",
    "relief": "Corrected relief",
}
_PSF = " The PSF is in decibels below its peak."


def write_design_report(folder: Path, design: Design, task: Task, history: list[dict[str, float]]) -> Path:
    """Write ``report.html`` and its CSV tables from the arrays in ``folder``."""
    levels, height_um, seen = (np.load(folder / name) for name in (LEVELS_FILE, HEIGHT_FILE, IMAGE_FILE))
    page = Page(
        _TITLES.get(design.task, design.task),
        f"Designed through the printer model “{design.printer.name}”; "
        "all scores are those of the printable layout.",
        run=design.run,
        facts=identity(design),
        words=WORDS,
    )
    page.verdict(
        f"As {design.printer.name} prints it: {headline(design.predicted)}. This is what the model that the "
        "layout was designed with expects, not a measurement: before printing, score it with another model "
        "(litho-design score, litho-design compare). " + width_sentence(design)
    )
    if design.baselines:
        line = baseline_line(design.baselines)
        page.paragraph(f"{capitalised(line)}.")
    page.figure(
        _pictures(folder, design, task, levels, height_um, seen),
        "Rows are y (down), columns x; lengths in µm." + (_PSF if isinstance(task, LensTask) else ""),
    )
    add_notes(page, design)
    if design.width is not None:
        rows = [
            {"layout": name, "printed by": model, **figures}
            for name, by_model in design.width.figures.items()
            for model, figures in by_model.items()
        ]
        page.table(rows, "The layout and the uncorrected ones, by every model at hand", "width.csv", digits=4)
    page.heading("All scores", folded=True)
    labels = meanings(task.score_type)
    if isinstance(task, LensTask):
        add_lens_curves(page, design, height_um, seen, task.bench)
    add_scores(page, design, labels)
    if design.reference_efficiency:
        _add_reference(page, design, task)
    page.heading("Search", folded=True)
    page.figure(progress_figure(history, design), "Loss of the sampled layout and of the printable layout.")
    page.paragraph(
        f"Loss of the printable layout: {design.start_loss:.4f} at the start, {design.argmax_loss:.4f} after "
        f"{design.iterations} iterations, {design.polished_loss:.4f} after the polish; the last sample had "
        f"{design.sample_loss:.4f} (soft-to-hard gap {design.argmax_loss - design.sample_loss:+.2g})."
    )
    import torch

    print_um = torch.from_numpy(height_um).to(task.printer.device)
    window = task.settings.window
    draws = task.window_scores(print_um, window.yield_draws)
    shown = [name for name in draws[0] if name in design.predicted]
    chosen = [name for name in task.headline if name in shown][:2] or shown[:2]
    figures = {name: (design.predicted[name], labels.get(name, named(name))) for name in chosen}
    add_yield(page, draws, window, figures, measure_yield(draws, design.predicted, task.errors), task.errors)
    page.heading("Printed height of the levels", folded=True)
    page.table(level_table(design), "Printed height of a uniform field of each level", "levels.csv", digits=3)
    page.paragraph(stroke_advice(design))
    add_gauge(page, design)
    page.heading("Settings", folded=True)
    page.code(design.model_dump_json(indent=1, include={"settings", "printer", "target"}))
    return page.write(folder)


def _add_reference(page: Page, design: Design, task: Task) -> None:
    reference, lens = design.reference_efficiency or 1.0, isinstance(task, LensTask)
    reached = design.predicted["focusing_efficiency" if lens else "eff_signal"] / reference
    what = (
        f"A perfect lens of this aperture puts {100 * reference:.1f} % within the same radius"
        if lens
        else f"A continuous phase optimised for power alone puts {100 * reference:.1f} % on the signal"
    )
    page.paragraph(f"{what}; the print reaches {reached:.2f} of that.")


def _pictures(
    folder: Path, design: Design, task: Task, levels: np.ndarray, height_um: np.ndarray, seen: np.ndarray
) -> Figure:
    side, window = design.layout.size_um, task.bench.window.size_um[0]
    panels: list[tuple[str, np.ndarray, str, tuple[float | None, float | None], str, float]] = [
        ("layout", levels, "viridis", (0, design.layout.levels - 1), "level", side),
        (f"print predicted by {design.printer.name}", height_um, "viridis", (None, None), "height, µm", side),
    ]
    if isinstance(task, LensTask):
        panels.append(("PSF", decibels(seen), "inferno", (-40, 0), "dB", window))
    elif isinstance(task, ReliefTask):
        error = 1000 * (height_um - task.inputs["relief_um"])
        rest = 1000 * np.load(folder / UNPRINTABLE_FILE)
        limit = 2 * float(np.std(error)) + 1e-9
        for title, off in (
            ("error, offset free", error - error.mean()),
            ("the part that no layout prints", rest),
        ):
            panels.append((title, off, "RdBu_r", (-limit, limit), "nm", side))
    elif isinstance(task, HologramTask):
        target = np.load(folder / TARGET_FILE)
        panels.append(("wanted image", target, "inferno", (0, 1), "intensity", window))
        scaled, unit = task.display(seen), "intensity, matched scale"
        panels.append(("behind the predicted print", scaled, "inferno", (0, BRIGHTEST), unit, window))
    else:
        shown, unit = task.display(seen), "over the brightest of each"
        panels.append(("behind the predicted print", shown, "inferno", (0, 1), unit, window))
    columns = 3 if len(panels) == 3 else 2
    figure = new_figure(13 if columns == 3 else 11, 4.2 if columns == 3 else 8.6)
    axes = figure.subplots(len(panels) // columns, columns).ravel()
    for axis, (title, array, colours, (low, high), unit, extent) in zip(axes, panels, strict=True):
        picture = axis.imshow(
            array, cmap=colours, vmin=low, vmax=high, extent=(0, extent, extent, 0), interpolation="nearest"
        )
        axis.set(title=title, xlabel="x, µm", ylabel="y, µm")
        figure.colorbar(picture, ax=axis, label=unit, shrink=0.8)
    return figure
