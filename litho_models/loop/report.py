"""Write the report of a loop from its record."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from litho_data.foundation import NM_PER_UM
from litho_data.reports.page import Page, sentences
from litho_data.reports.pictures import colour_bar_png, coloured_png, thumbnail
from litho_data.store import PrintedScan
from litho_models.loop.record import CloseLoop, FoundEffect


def write_report(
    result: CloseLoop, scans: Sequence[PrintedScan], maps_um: Iterable[Sequence[np.ndarray]], folder: Path
) -> Path:
    """Write ``report.html`` and its tables.

    Args:
        result: the record of the loop.
        scans: the scans for development.
        maps_um: two lists of maps that these scans are expected to show, µm, of shape (ny, nx). The base
            model predicts the maps of the first list, and the corrected model predicts the maps of the second
            list.
        folder: folder to which the files are written.
    """
    page = Page(
        f"What {result.base_model} lacks on {result.dataset.name}",
        "Causes and empirical laws in the residual on held-out scans, and errors of the corrected model.",
        run=result.run,
        facts={"dataset": result.dataset.sha256, "seeds": ", ".join(map(str, result.run.seeds))},
        words=Path(__file__).with_name("words.toml"),
    )
    page.verdict(said("verdict", result))
    shown = [
        result.error("base", measurement="published"),
        *(row for row in result.errors if row.is_headline),
    ]
    page.tiles([(f"{row.leading_nm:.2f} nm", said("stage", row)) for row in shown if row])
    page.paragraph("Mean error on held-out scans.")
    if result.effects:
        page.heading("What was found")
        page.points([said("effect", one) for one in result.effects])
        page.table(
            result.effects,
            "Effects added to the model.",
            "effects.csv",
            columns=(
                "name",
                "knowledge",
                "verdict",
                "role",
                "by",
                "gain_nm2",
                "left_out_nm",
                "p_confirm",
                "family_p",
                "confusable_with",
            ),
        )
        page.table(
            _strength_rows(result.effects),
            "Fitted parameters of these effects, with 95 % confidence intervals from the scatter over prints "
            "(or over scans, if there are too few prints).",
            "strengths.csv",
            digits=3,
        )
    if result.decisions:
        page.heading("What the new prints decide")
        page.points([said("decision", one) for one in result.decisions])
    page.heading("Where the residual lies")
    _residuals(page, scans, maps_um)
    page.table(
        result.explained,
        "Squared error on held-out scans after each stage of the loop, and the part of it that a ridge "
        "regression on features of the layout and of the position can still explain.",
        "explained.csv",
    )
    page.heading("All errors")
    page.table(
        [row.model_dump(exclude={"by_scan_nm", "edge_by_scan_nm"}) for row in result.errors],
        "Each row states its model, its measurement model and the terms fitted to each scan. All rows are "
        "computed in the same way.",
        "errors.csv",
    )
    page.heading("Measurement errors that scans share", folded=True)
    page.paragraph(said("measurement", result.measurement))
    page.heading("Terms that differ from scan to scan", folded=True)
    page.table(
        [one.model_dump() | {"spread": said("spread", one)} for one in result.single_scans],
        "These terms differ from scan to scan, so no model contains them. The spread is the standard "
        "deviation over scans.",
        "single_scans.csv",
    )
    if result.planted:
        page.heading("What was planted in copies of the scans")
        page.table(
            result.planted,
            "Effects that were planted in copies of the scans, and what the loop found in these copies.",
            "planted.csv",
            digits=3,
        )
    page.heading("Every other candidate", folded=True)
    page.table(result.candidates, "Why each candidate was not added.", "candidates.csv")
    return page.write(folder)


def said(about: str, one: object) -> str:
    """Describe an object in words. The text is made by a macro of ``sentences.jinja``. ``about`` is the name
    of the macro, such as ``verdict`` (for a result), ``effect``, ``decision`` or ``measurement``.
    """
    return sentences(Path(__file__).with_name("sentences.jinja"), about, one)


def _residuals(page: Page, scans: Sequence[PrintedScan], maps_um: Iterable[Sequence[np.ndarray]]) -> None:
    pairs = []
    for scan, *expected in zip(scans, *maps_um, strict=True):
        left = [np.where(scan.usable, NM_PER_UM * (scan.height_um - own), np.nan) for own in expected]
        pairs.append([own - np.nanmedian(own) for own in left])
    limit_nm = 2.5 * float(np.sqrt(np.mean([np.nanmean(before**2) for before, _ in pairs])))
    bar = colour_bar_png("RdBu_r")
    titles = [(f"{when}, {-limit_nm:.0f} … {limit_nm:.0f} nm", bar) for when in ("before", "after")]
    rows = []
    for scan, pair in zip(scans, pairs, strict=True):
        errors = " → ".join(f"{np.nanmean(np.abs(own)):.1f}" for own in pair)
        shown = [coloured_png(thumbnail(own), "RdBu_r", -limit_nm, limit_nm) for own in pair]
        rows.append((f"{scan.id}: {errors} nm", shown))
    page.gallery(
        titles,
        rows,
        "Measured minus expected height of each scan, before and after the correction of the model. The "
        "numbers are the mean absolute errors of the two maps.",
    )


def _strength_rows(effects: Sequence[FoundEffect]) -> list[dict[str, object]]:
    return [
        {
            "effect": one.name,
            "parameter": name,
            "group": own.label,
            "value": own.value,
            "unit": own.unit,
            "from": low,
            "to": high,
        }
        for one in effects
        for name, strengths in one.strengths.items()
        for own in strengths
        for low, high in [own.ci95 or (None, None)]
    ]
