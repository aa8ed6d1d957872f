"""Write the report of one design of any task."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from litho_data.reports.page import Page, capitalised
from litho_design.holograms.task import HologramTask
from litho_design.lenses.task import LensTask
from litho_design.optimisation.process_window import PASS_DROP_DB, PASS_SHARE, measure_yield, spreads
from litho_design.reliefs.task import UNPRINTABLE_FILE, ReliefTask
from litho_design.reports.advice import (
    WORDS,
    baseline_line,
    distribution_warning,
    headline,
    named,
    stroke_advice,
    thickness_warning,
    width_sentence,
)
from litho_design.reports.pictures import (
    Panel,
    decibels,
    lens_curves,
    panels_figure,
    progress_figure,
    yield_figure,
)
from litho_design.reports.tables import level_table, meanings, score_table
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, TARGET_FILE, Design
from litho_design.tasks.task import Task

_TITLES = {
    "hoe": "Holographic element",
    "lens-direct": "Multi-level diffractive lens",
    "lens-computational": "Multi-level diffractive lens with deconvolution",
    "relief": "Corrected relief",
}
_PSF = " The PSF is in decibels below its peak."


def write_design_report(folder: Path, design: Design, task: Task, history: list[dict[str, float]]) -> Path:
    """Write ``report.html`` and its CSV tables into ``folder``, which already contains the arrays of the
    design.
    """
    height_um, seen = (np.load(folder / name) for name in (HEIGHT_FILE, IMAGE_FILE))
    lens = isinstance(task, LensTask)
    facts = {
        "printer": design.printer.name,
        "printer, SHA-256": design.printer.sha256,
        "seed": task.settings.search.seed,
    }
    page = Page(
        _TITLES.get(design.task, design.task),
        f"Designed through the printer model “{design.printer.name}”; "
        "all scores are those of the printable layout.",
        run=design.run,
        facts=facts,
        words=WORDS,
    )
    page.verdict(
        f"As printed by {design.printer.name}: {headline(design.predicted)}. This is a prediction of the "
        "model used for the design, not a measurement. Before printing, score the layout with another model "
        "(litho-design score, litho-design compare). " + width_sentence(design)
    )
    if design.baselines:
        page.paragraph(f"{capitalised(baseline_line(design.baselines))}.")
    page.figure(
        panels_figure(_panels(folder, design, task, height_um, seen)),
        "Rows are y (down), and columns are x; lengths are in µm." + _PSF * lens,
    )
    notes = filter(None, (distribution_warning(design), thickness_warning(design), *design.notes))
    page.note(*(f"{capitalised(note)}." for note in notes))
    if design.width is not None:
        rows = [
            {"layout": name, "printed by": model, **figures}
            for name, by_model in design.width.figures.items()
            for model, figures in by_model.items()
        ]
        page.table(
            rows,
            "The layout found by the search and the uncorrected layout, as printed by every available model",
            "width.csv",
            digits=4,
        )
    page.heading("All scores", folded=True)
    if lens:
        page.figure(
            lens_curves(height_um, seen, task.bench), "Print along the central row, PSF profile, and MTF."
        )
    _add_scores(page, design, task)
    page.heading("Search", folded=True)
    page.figure(progress_figure(history, design), "Loss of the sampled layout and of the printable layout.")
    page.paragraph(
        f"Loss of the printable layout: {design.start_loss:.4f} at the start, {design.argmax_loss:.4f} after "
        f"{design.iterations} iterations, {design.polished_loss:.4f} after the polish. The last "
        f"sampled layout, whose levels are not rounded, had a loss of {design.sample_loss:.4f}; that of the "
        f"printable layout before the polish differs from it by "
        f"{design.argmax_loss - design.sample_loss:+.2g}."
    )
    _add_yield(page, design, task, torch.from_numpy(height_um).to(task.printer.device))
    page.heading("Printed height of the levels", folded=True)
    page.table(level_table(design), "Printed height of a uniform field of each level", "levels.csv", digits=3)
    page.paragraph(stroke_advice(design))
    if tiling := design.tiling:
        page.paragraph(
            f"The print was predicted as a whole and in {tiling.tiles} tiles of {tiling.tile_px} px with "
            f"halos. The two predictions differ by {tiling.rms_nm:.2g} nm rms and by at most "
            f"{tiling.max_nm:.2g} nm."
        )
    if design.out_of_distribution is not None:
        distance = design.out_of_distribution.model_dump(exclude={"flagged"})
        page.table([distance], "Distance from the model's training layouts", "distance.csv", digits=3)
    page.heading("Settings", folded=True)
    page.code(design.model_dump_json(indent=1, include={"settings", "printer", "target"}))
    return page.write(folder)


def _panels(
    folder: Path, design: Design, task: Task, height_um: np.ndarray, seen: np.ndarray
) -> list[list[Panel]]:
    side, window = design.layout.size_um, task.bench.window.size_um[0]
    levels, printed = np.load(folder / LEVELS_FILE), f"print predicted by {design.printer.name}"
    first = [
        Panel("layout", levels, side, "level", "viridis", 0, design.layout.levels - 1),
        Panel(printed, height_um, side, "height, µm", "viridis", None, None),
    ]
    if isinstance(task, LensTask):
        return [[*first, Panel("PSF", decibels(seen), window, "dB", low=-40, high=0)]]
    if isinstance(task, ReliefTask):
        error = 1000 * (height_um - task.inputs["relief_um"])
        limit = 2 * float(np.std(error)) + 1e-9
        maps = {
            "error without its mean": error - error.mean(),
            "the part of the relief that no layout can print": 1000 * np.load(folder / UNPRINTABLE_FILE),
        }
        return [first, [Panel(*one, side, "nm", "RdBu_r", -limit, limit) for one in maps.items()]]
    behind = "image behind the predicted print", task.display(seen), window
    if isinstance(task, HologramTask):
        wanted = Panel("target image", np.load(folder / TARGET_FILE), window, "intensity", high=1)
        return [first, [wanted, Panel(*behind, "intensity, matched scale")]]
    return [[*first, Panel(*behind, "relative to the brightest value", high=1)]]


def _add_scores(page: Page, design: Design, task: Task) -> None:
    """Add the scores of a design, and the scores of its baselines, which are computed on the same grid."""
    baselines = design.baselines or {}
    thick = {} if design.thick is None else {"print, thick element": design.thick}
    page.table(
        score_table({"print": design.predicted} | thick | baselines, meanings(task.score_type)),
        "Scores of the printable layout as printed, and of its baselines on the same grid",
        "scores.csv",
        digits=4,
    )
    ceiling, settings = baselines.get("continuous phase", {}).get("loss"), task.settings
    if ceiling is not None and not settings.fabrication.inside_weight and not settings.window.samples:
        page.paragraph(
            f"The loss of the printed layout is {design.polished_loss:.4f}. A continuous phase on the same "
            f"cells reaches {ceiling:.4f}; the loss of the printed layout differs from this value by "
            f"{100 * (design.polished_loss / ceiling - 1):+.1f} %."
        )
    if reference := design.reference_efficiency:
        page.paragraph(
            f"A continuous phase optimised for power alone puts {100 * reference:.1f} % of the light on the "
            f"signal; the print reaches {design.predicted['eff_signal'] / reference:.2f} times this share."
        )


def _add_yield(page: Page, design: Design, task: Task, print_um: Any) -> None:
    """Add the yield, which is the share of random prints that pass, and the scores of these prints."""
    window, errors = task.settings.window, task.errors
    draws = task.window_scores(print_um, window.yield_draws)
    passed = measure_yield(draws, design.predicted, errors)
    page.heading("Process window", folded=True)
    included = "included" if window.samples else "did not include"
    page.paragraph(
        f"The curves give the share of {len(draws)} random prints that are at least as good as the value on "
        f"the axis. The search did not use these prints; its loss {included} the process window. The "
        f"standard deviations of the process window are: {'; '.join(spreads(window, design.optics))}."
    )
    low, high = (round(100 * edge) for edge in passed.ci95)
    grown = f", and no error may exceed {100 / PASS_SHARE:.0f} % of it"
    page.paragraph(
        f"{passed.passed} of {passed.draws} prints pass ({low} to {high} %, 95 % confidence interval). To "
        f"pass, a print must have figures in dB that are at most {PASS_DROP_DB:g} dB below those of the "
        f"print as modelled. Every other figure must reach at least {100 * PASS_SHARE:g} % of the modelled "
        f"value"
        f"{grown * bool(set(errors) & set(passed.figures))}. "
        f"The following figures are compared: {', '.join(map(named, passed.figures))}."
    )
    chosen = [name for name in task.headline if name in passed.figures][:2] or passed.figures[:2]
    figures = {name: (design.predicted[name], named(name)) for name in chosen}
    page.figure(
        yield_figure(draws, figures, errors), "Yield curves; the dashed line is the print as modelled."
    )
    page.table(draws, "Figures of each random print", "window.csv", digits=3)
