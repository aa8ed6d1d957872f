"""Sections and plots that several reports share."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation.results import Record
from litho_data.reports.page import Page, capitalised
from litho_data.reports.pictures import new_figure
from litho_design.optimisation.process_window import PASS_DROP_DB, PASS_SHARE, ProcessWindow, Yield, spreads
from litho_design.reports.advice import (
    distribution_warning,
    named,
    thickness_warning,
)
from litho_design.tasks.design import Design

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Brightest intensity shown, in units of the target's white; speckle beyond it is clipped.
BRIGHTEST = 1.5


def add_notes(page: Page, design: Design) -> None:
    """Warnings that the scores may not hold for the layout or element, and the remarks of the record."""
    notes = filter(None, (distribution_warning(design), thickness_warning(design), *design.notes))
    page.note(*(f"{capitalised(note)}." for note in notes))


def identity(design: Design) -> dict[str, object]:
    """The facts that identify a design at the foot of its report: hashes of printer and target, seed."""
    search = design.settings.get("search", {})
    facts = {"printer": design.printer.name, "printer, SHA-256": design.printer.sha256}
    return {
        name: value for name, value in (facts | {"seed": search.get("seed")}).items() if value is not None
    }


def progress_figure(history: list[dict[str, float]], design: Design) -> Figure:
    """Loss against iteration."""
    figure = new_figure(8, 3.4)
    axis = figure.subplots()
    steps = [entry["iteration"] for entry in history]
    axis.plot(steps, [entry["sample_loss"] for entry in history], color="#9aa7b5", label="sampled layout")
    axis.plot(steps, [entry["argmax_loss"] for entry in history], color="#2f7fd0", label="printable layout")
    axis.axhline(design.polished_loss, color="#3a9142", linewidth=1, label="after polish")
    axis.set(xlabel="iteration", ylabel="loss")
    axis.legend()
    return figure


def add_yield(
    page: Page,
    draws: list[dict[str, float]],
    window: ProcessWindow,
    figures: dict[str, tuple[float, str]],
    passed: Yield,
    errors: Collection[str],
) -> None:
    """Yield curves of a design.

    Args:
        draws: figures of single prints on single benches.
        window: the spreads of the draws.
        figures: for each name, the value of the print as modelled and a label.
        passed: the result of the draws that pass.
        errors: figures that are better when lower.
    """
    page.heading("Process window", folded=True)
    designed = "in the loss" if window.samples else "not in the loss"
    page.paragraph(
        f"The curves give the share of {len(draws)} random prints that are at least as good as the value on "
        f"the axis. The search did not use these prints; the process window was {designed}. Standard "
        f"deviations: {'; '.join(spreads(window))}."
    )
    low, high = (round(100 * edge) for edge in passed.ci95)
    grown = f", an error grows to {100 / PASS_SHARE:.0f} % at most"
    grown = grown if set(errors) & set(passed.figures) else ""
    page.paragraph(
        f"{passed.passed} of {passed.draws} prints pass ({low} to {high} %, 95 % interval): no figure in dB "
        f"is more than {PASS_DROP_DB:g} dB below the print as modelled, every other one keeps "
        f"{100 * PASS_SHARE:g} % of it{grown}. Judged by {', '.join(map(named, passed.figures))}."
    )
    figure = new_figure(8, 3)
    (axes,) = figure.subplots(1, len(figures), sharey=True, squeeze=False)
    for axis, (name, (modelled, label)) in zip(axes, figures.items(), strict=True):
        values = np.sort([draw[name] for draw in draws])
        worse = np.arange(len(values)) / len(values)
        if name in errors:
            axis.step(values, worse + 1 / len(values), where="post")
        else:
            axis.step(values, 1 - worse, where="pre")
        axis.axvline(modelled, color="0.5", linestyle="--", linewidth=1)
        axis.set_xlabel(label)
    axes[0].set_ylabel("yield")
    page.figure(figure, "Yield curves; the dashed line is the print as modelled.")
    page.table(draws, "Single draws", "window.csv", digits=3)


def meanings(score: type[Record]) -> dict[str, str]:
    """The meaning of each number of a score."""
    return {name: field.description or "" for name, field in score.model_fields.items()}


def score_table(
    columns: Mapping[str, Mapping[str, float]], labels: Mapping[str, str]
) -> list[dict[str, Any]]:
    """One row per figure, one column per print or baseline, and the meaning of each figure."""
    # A task of your own need not describe its figures.
    names = dict.fromkeys(
        name for figures in columns.values() for name in figures if name in labels or not labels
    )
    return [
        {"name": name}
        | {title: figures.get(name, np.nan) for title, figures in columns.items()}
        | ({"meaning": labels[name]} if labels else {})
        for name in names
    ]


def add_scores(page: Page, design: Design, labels: Mapping[str, str]) -> None:
    """The scores of a design beside those of its baselines on the same grid."""
    thick = {} if design.thick is None else {"print, thick element": design.thick}
    columns = {"print": design.predicted} | thick | (design.baselines or {})
    page.table(
        score_table(columns, labels),
        "Scores of the printable layout as printed, and of its baselines on the same grid",
        "scores.csv",
        digits=4,
    )
    ceiling = (design.baselines or {}).get("continuous phase", {}).get("loss")
    made = design.settings.get("fabrication", {})
    penalised = any(made.get(name) for name in ("max_step_levels", "min_feature_um", "inside_weight"))
    if ceiling is not None and not penalised and not design.settings["window"]["samples"]:
        page.paragraph(
            f"The loss of the printed layout is {design.polished_loss:.4f}; a continuous phase on the same "
            f"cells reaches {ceiling:.4f} ({100 * (design.polished_loss / ceiling - 1):+.1f} % against it)."
        )


def level_table(design: Design) -> dict[str, Any]:
    """Level, nominal and printed height, and printed waves above level 0."""
    printed, step_um = design.stroke.printed_height_um, design.layout.level_height_um
    wave_um = design.optics.wave_height_um
    return {
        "level": range(len(printed)),
        "nominal_um": [level * step_um for level in range(len(printed))],
        "printed_um": printed,
        "printed_waves": [(height - printed[0]) / wave_um for height in printed],
    }


def add_gauge(page: Page, design: Design) -> None:
    """Add what a printer must resolve, and the distance from the model's training layouts."""
    page.heading("What the printer must resolve", folded=True)
    gauge = design.out_of_distribution
    tiling, ensemble = design.tiling, design.ensemble
    if tiling is not None:
        page.paragraph(
            f"Predicted as a whole and in {tiling.tiles} tiles of {tiling.tile_px} px with their halo, the "
            f"print differs by {tiling.rms_nm:.2g} nm rms, {tiling.max_nm:.2g} nm at most."
        )
    if ensemble is not None:
        names = ", ".join(member.name for member in ensemble.members)
        page.paragraph(
            f"Designed with {names} as well: on this layout the models disagree by "
            f"{ensemble.disagreement_nm:.1f} nm ({ensemble.disagreement_waves:.3f} waves) rms."
        )
    figures = design.printability.model_dump() | (gauge.model_dump() if gauge else {})
    given = {name: value for name, value in figures.items() if isinstance(value, (int, float))}
    # Separate values, so that a count stays a whole number.
    frame = {"name": list(given), "value": np.array(list(given.values()), dtype=object)}
    page.table(frame, "Lengths in µm; shares of pixel pairs or runs", "printability.csv", digits=3)


def picture_grid(
    rows: Mapping[str, Mapping[str, np.ndarray]],
    side_um: float,
    colours: str = "inferno",
    highest: float = BRIGHTEST,
    unit: str = "",
) -> Figure:
    """Pictures in rows and columns, all on one scale from 0.

    Args:
        rows: label of each row to its pictures (m, m), by title.
        side_um: extent of every picture, µm.
        highest: value of the brightest colour, by default that of white in the target.
        unit: unit of the colour bar; without it there is no bar.
    """
    columns = max(map(len, rows.values()))
    two_lines = any("\n" in title for row in rows.values() for title in row)
    figure = new_figure(2.3 * columns + 0.6 + bool(unit), (2.6 if two_lines else 2.45) * len(rows))
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for own, (label, pictures) in zip(axes, rows.items(), strict=True):
        for axis, (title, picture) in zip(own, pictures.items(), strict=True):
            extent = (0, side_um, side_um, 0)
            shown = axis.imshow(picture, cmap=colours, vmin=0, vmax=highest, extent=extent)
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_title(title, fontsize=10)
        own[0].set_ylabel(label, fontsize=10)
    if unit:
        figure.colorbar(shown, ax=axes.ravel().tolist(), label=unit, shrink=0.8)
    return figure
