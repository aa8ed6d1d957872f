"""The report of a loop for people, drawn from its record: the answer, pictures, tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.reports.page import Page, capitalised
from litho_data.reports.pictures import new_figure
from litho_models.loop.record import CloseLoop, Decision, ErrorRow, FoundEffect, ScanFinding
from litho_models.scan_terms.grouped import ALL

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Maps = Sequence[tuple[str, np.ndarray, np.ndarray]]
_BEFORE, _AFTER = "#9aa5b1", "#2f7fd0"
_STAGES = {
    "base": "base",
    "causes": "with the causes",
    "all": "corrected",
}
_SHOWN_SCANS = 3
_OF_EFFECT = (
    *("name", "knowledge", "verdict", "role", "by", "gain_nm2", "left_out_nm", "p_confirm", "family_p"),
    "confusable_with",
)


def write_report(result: CloseLoop, maps: Maps, folder: Path) -> Path:
    """Write ``report.html`` and its tables; ``maps``: residual (y, x), nm, by scan, before and after."""
    page = Page(
        f"What {result.base_model} lacks on {result.dataset.name}",
        "From the residual on held-out scans to causes and laws, to a corrected model.",
        run=result.run,
        facts={"dataset": result.dataset.sha256, "seeds": ", ".join(map(str, result.run.seeds))},
        words=Path(__file__).with_name("words.toml"),
    )
    page.verdict(verdict_text(result))
    page.tiles(
        [(f"{row.leading_nm:.2f} nm", f"{_STAGES[row.model]}, k = {row.k:g}") for row in _headline(result)]
    )
    page.figure(_bars(result), "Error on held-out scans. Grey: the base.")
    if result.effects:
        page.heading("What was found")
        page.points([effect_text(one) for one in result.effects])
        page.table(result.effects, "What was added.", "effects.csv", columns=_OF_EFFECT)
        page.table(
            [row for one in result.effects for row in _strength_rows(one)],
            "Strengths with 95 % intervals, by what each print (or scan) asks for.",
            "strengths.csv",
            digits=3,
        )
    if result.decisions:
        page.heading("What new prints decide")
        page.points([decision_text(one) for one in result.decisions])
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
    page.paragraph(measurement_text(result))
    page.heading("What single scans add", folded=True)
    page.table(
        [_scan_row(one) for one in result.single_scans],
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


def verdict_text(result: CloseLoop) -> str:
    """The answer in one or two sentences."""
    names = [one.name + _by(one) for one in result.effects if one.knowledge == "cause"]
    laws = [one.title for one in result.effects if one.knowledge == "law"]
    before, after = _headline(result)[0], _headline(result)[-1]
    what = "edge error" if before.edge_by_scan_nm else "error"
    gain = (
        f"On held-out scans the {what} goes from {before.leading_nm:.2f} to {after.leading_nm:.2f} nm "
        f"(k = {before.k:g})."
    )
    found = "; ".join(
        part
        for part in (
            f"the model lacks {', '.join(names)}" if names else "",
            f"and follows {'; '.join(laws)}" if laws and names else "",
            f"the {'; '.join(laws)}" if laws and not names else "",
        )
        if part
    )
    if result.verdict == "traced":
        return f"{found[0].upper()}{found[1:]}. {gain}"
    said = {
        "described": "What is left follows the layout or the place, but no cause and no short law holds.",
        "nothing-missing": "Nothing is missing that these scans can show.",
        "unexplained": "Something is missing: no cause, law or table holds on held-out scans.",
        "too-few-scans": f"Nothing can be confirmed: at least {result.fewest_scans} scans are needed.",
    }
    return f"{said[result.verdict]} {gain}"


def effect_text(one: FoundEffect) -> str:
    """An effect with its size, in a sentence."""
    sizes = [
        f"{name} {own.value:.3g}{'' if own.unit == '1' else ' ' + own.unit}"
        f"{f' ({own.label})' if own.label else ''}"
        for name, strengths in one.strengths.items()
        for own in strengths
    ]
    better, count = one.scans_improved
    alike = (
        f" These scans cannot tell it from {', '.join(one.confusable_with)}." if one.confusable_with else ""
    )
    bases = f" It holds on {', '.join(one.survives_on)} too." if one.survives_on else ""
    return (
        f"{one.name}{_by(one)}: {one.title}; {', '.join(sizes)}. It takes {one.gain_nm2:.0f} of "
        f"{one.before_nm2:.0f} nm² and is better on {better} of {count} held-out scans.{alike}{bases}"
    )


def decision_text(one: Decision) -> str:
    """What new prints say of a question."""
    left = ", ".join(one.left) or "none"
    return f"New prints on {one.question}: {one.verdict}, {left}. {capitalised(one.evidence)}."


def measurement_text(result: CloseLoop) -> str:
    """What the scans share, in words."""
    parts = [
        f"{part.what} by {part.by} (degree {part.degree}, {part.numbers} numbers)"
        for part in result.measurement.parts
    ]
    levelled = {"none": "not levelled", "plane": "freed of x and y", "twist": "freed of x, y and xy"}
    state = levelled.get(result.measurement.levelling, "freed of x, y, xy, x² and y²")
    return f"Predictions are {state}, as the files are. Shared: {'; '.join(parts) or 'nothing'}."


def _by(one: FoundEffect) -> str:
    return "" if one.by == ALL else f" by {one.by}"


def _headline(result: CloseLoop) -> list[ErrorRow]:
    rows = [result.error(stage) for stage in ("base", "causes", "all")]
    return [row for row in rows if row is not None]


def _bars(result: CloseLoop) -> Figure:
    rows = [row for row in (result.error("base", "offset", "published"), *_headline(result)) if row]
    labels = ["base, published protocol", *(_STAGES[row.model] for row in rows[1:])]
    figure = new_figure(9, 0.45 * len(rows) + 1.1)
    axes = figure.subplots()
    at = np.arange(len(rows))[::-1]
    colours = [_BEFORE if row.model == "base" else _AFTER for row in rows]
    drawn = axes.barh(at, [row.leading_nm for row in rows], color=colours, height=0.66)
    axes.bar_label(drawn, fmt="%.2f", padding=4)
    axes.set_yticks(at, labels)
    axes.margins(x=0.15)
    axes.set_xlabel("error on held-out scans (nm)")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _residuals(maps: Maps) -> Figure:
    size = [float(np.nanmean(before**2)) for _, before, _ in maps]
    order = np.argsort(size)[::-1]
    picked = order[np.unique(np.linspace(0, len(order) - 1, _SHOWN_SCANS).astype(int))]
    limit = 2.5 * float(np.sqrt(np.mean(size)))
    figure = new_figure(4 * len(picked) + 0.8, 8)
    axes = figure.subplots(2, len(picked), squeeze=False)
    for column, at in enumerate(picked):
        name, *pair = maps[at]
        for row, own in enumerate(pair):
            panel = axes[row, column]
            panel.imshow(own, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
            panel.set_title(
                f"{name} {('before', 'after')[row]}: {np.nanmean(np.abs(own)):.1f} nm", fontsize=10
            )
            panel.set_axis_off()
    figure.colorbar(axes[0, 0].images[0], ax=axes, label="measured - expected (nm)", shrink=0.6)
    return figure


def _scan_row(one: ScanFinding) -> dict[str, object]:
    spread = (f"{name} {own.value:.3g} {own.unit}" for name, own in one.spread.items())
    return {**one.model_dump(), "spread": ", ".join(spread)}


def _strength_rows(one: FoundEffect) -> list[dict[str, object]]:
    return [
        {
            "effect": one.name,
            "parameter": name,
            "group": own.label,
            "value": own.value,
            "unit": own.unit,
            "from": None if own.ci95 is None else own.ci95[0],
            "to": None if own.ci95 is None else own.ci95[1],
        }
        for name, strengths in one.strengths.items()
        for own in strengths
    ]
