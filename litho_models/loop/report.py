"""The report of a loop for people, drawn from its record: the answer, pictures, tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.reports.page import Page, sentences
from litho_data.reports.pictures import new_figure
from litho_models.loop.record import CloseLoop, ErrorRow, FoundEffect, ScanFinding

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Maps = Sequence[tuple[str, np.ndarray, np.ndarray]]


def write_report(result: CloseLoop, maps: Maps, folder: Path) -> Path:
    """Write ``report.html`` and its tables; ``maps``: residual (y, x), nm, by scan, before and after."""
    page = Page(
        f"What {result.base_model} lacks on {result.dataset.name}",
        "From the residual on held-out scans to causes and laws, to a corrected model.",
        run=result.run,
        facts={"dataset": result.dataset.sha256, "seeds": ", ".join(map(str, result.run.seeds))},
        words=Path(__file__).with_name("words.toml"),
    )
    page.verdict(said("verdict", result))
    page.tiles(
        [(f"{row.mae_nm:.2f} nm", f"{said('stage', row.model)}, k = {row.k:g}") for row in _headline(result)]
    )
    page.figure(_bars(result), "Error on held-out scans, zero of each scan free. Grey: the base.")
    if result.effects:
        page.heading("What was found")
        page.points([said("effect", one) for one in result.effects])
        columns = (
            *("name", "knowledge", "verdict", "role", "by", "gain_nm2", "left_out_nm", "p_confirm"),
            *("family_p", "confusable_with"),
        )
        page.table(result.effects, "What was added.", "effects.csv", columns=columns)
        page.table(
            [row for one in result.effects for row in _strength_rows(one)],
            "Strengths with 95 % intervals, by what each print (or scan) asks for.",
            "strengths.csv",
            digits=3,
        )
    if result.decisions:
        page.heading("What new prints decide")
        page.points([said("decision", one) for one in result.decisions])
    page.heading("Where the residual lies")
    page.figure(_residuals(maps), "Measured minus expected, before (top) and after (below).")
    page.table(
        result.explained,
        "What a ridge over features of layout and place still explains, out of fold.",
        "explained.csv",
    )
    page.heading("All errors")
    page.table(
        [row.model_dump(exclude={"by_scan_nm"}) for row in result.errors],
        "Each row says which terms it has. Rows of one column are made alike.",
        "errors.csv",
    )
    page.heading("What scans share beside their prints", folded=True)
    page.paragraph(said("measurement", result.measurement))
    page.heading("What single scans add", folded=True)
    page.table(
        [one.model_dump() | {"spread": _spread(one)} for one in result.single_scans],
        "Each scan its own; no model has it. Spread: standard deviation over scans.",
        "single_scans.csv",
    )
    if result.planted:
        page.heading("What was planted in copies of the scans")
        page.table(result.planted, "Is it named?", "planted.csv", digits=3)
    if result.confounded:
        page.paragraph(f"Known together only: {'; '.join(f'{a} and {b}' for a, b, _ in result.confounded)}.")
    page.heading("Every other candidate", folded=True)
    page.table(result.candidates, "Why it was not added.", "candidates.csv")
    return page.write(folder)


def said(about: str, one: object) -> str:
    """In words: the ``verdict`` of a result, an ``effect``, a ``decision``, a ``measurement`` model."""
    return sentences(Path(__file__).with_name("sentences.jinja"), about, one)


def _headline(result: CloseLoop) -> list[ErrorRow]:
    """Errors of the stages, k = 1, with the shared measurement."""
    return [row for row in result.errors if row.is_headline]


def _bars(result: CloseLoop) -> Figure:
    rows = [row for row in (result.error("base", measurement="published"), *_headline(result)) if row]
    labels = ["base, published protocol", *(said("stage", row.model) for row in rows[1:])]
    figure = new_figure(9, 0.45 * len(rows) + 1.1)
    axes = figure.subplots()
    at = np.arange(len(rows))[::-1]
    colours = ["#9aa5b1" if row.model == "base" else "#2f7fd0" for row in rows]
    drawn = axes.barh(at, [row.mae_nm for row in rows], color=colours, height=0.66)
    axes.bar_label(drawn, fmt="%.2f", padding=4)
    axes.set_yticks(at, labels)
    axes.margins(x=0.15)
    axes.set_xlabel("mean absolute error on held-out scans (nm)")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _residuals(maps: Maps) -> Figure:
    """Maps of the scans with the largest, a middling and the smallest error of the base."""
    size = [float(np.nanmean(before**2)) for _, before, _ in maps]
    order = np.argsort(size)[::-1][[0, (len(maps) - 1) // 2, -1]].tolist()
    shown = [maps[at] for at in dict.fromkeys(order)]
    limit = 2.5 * float(np.sqrt(np.mean(size)))
    figure = new_figure(4 * len(shown) + 0.8, 8)
    axes = figure.subplots(2, len(shown), squeeze=False)
    for column, (name, *pair) in zip(axes.T, shown, strict=True):
        for panel, when, own in zip(column, ("before", "after"), pair, strict=True):
            panel.imshow(own, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
            panel.set_title(f"{name} {when}: {np.nanmean(np.abs(own)):.1f} nm", fontsize=10)
            panel.set_axis_off()
    figure.colorbar(axes[0, 0].images[0], ax=axes, label="measured - expected (nm)", shrink=0.6)
    return figure


def _strength_rows(one: FoundEffect) -> list[dict[str, object]]:
    rows = []
    for name, strengths in one.strengths.items():
        for own in strengths:
            low, high = own.ci95 or (None, None)
            facts = {"group": own.label, "value": own.value, "unit": own.unit, "from": low, "to": high}
            rows.append({"effect": one.name, "parameter": name, **facts})
    return rows


def _spread(one: ScanFinding) -> str:
    return ", ".join(f"{name} {own.value:.3g} {own.unit}" for name, own in one.spread.items())
