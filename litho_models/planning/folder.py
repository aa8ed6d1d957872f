"""Write the plan as a folder: a dataset without its scans, and instruction sheets for printer and
microscope.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from litho_data.cards.card import Use
from litho_data.foundation.files import atomic_file
from litho_data.layouts.card_text import TABLE_NAME, write_card, write_layout, write_table
from litho_data.layouts.patterns import flat, framed_ladder
from litho_data.reports.page import filled
from litho_models.planning.layouts import WORDS, Limits
from litho_models.planning.record import NextPrint, PlannedScan
from litho_models.planning.rivalry import PlannedPrint, Printing, Way

PRINT_PATTERN = r"N(?P<print>\d+)F\d+"
PRINTER_SHEET, MICROSCOPE_SHEET = "printer.md", "microscope.md"
_TEMPLATES = Path(__file__).parent
HOLDS = (
    "card.toml",
    "scans.csv",
    "layouts",
    NextPrint.FILE_NAME,
    "report.html",
    "*.csv",
    PRINTER_SHEET,
    MICROSCOPE_SHEET,
)
_COLUMNS = (
    *("id", "order", "field_x_um", "field_y_um", "dose", "use"),
    *("turned_deg", "direction", "tip", "pixel_size"),
)
_REFERENCES = {
    "substrate": "zero, tilt and bow without a print",
    "flat": "the noise floor",
    "steps": "height against level; the microscope's gain on a step standard",
    "grating": "scales and unevenness of the scanner, and the tip",
}
# Descriptions of the references on the printer's sheet.
_USES = {
    "substrate": "bare substrate, nothing printed: zero, tilt and bow of the microscope",
    "flat": "one level everywhere: the noise floor",
    "steps": "a stair: height against level",
}
# Periods of commercial gratings, µm, and the smallest number of periods that a field must contain.
_PERIODS_UM, _FEWEST_PERIODS = (10.0, 5.0, 3.0, 2.0, 1.0), 8


_TREAD_PX = 30
_LADDER_PX = 5 * _TREAD_PX


def schedule(
    planned: Sequence[PlannedPrint], limits: Limits, printing: Printing, seed: int
) -> tuple[list[PlannedScan], list[np.ndarray]]:
    """Return the planned scans, which are the rows of the table, and the layout of each scan."""
    size_px = len(planned[0].level)
    # A stair looks the same when shifted, so it gets a frame if there is room.
    ladder = limits.random(size_px, seed + 13)
    if size_px >= _LADDER_PX:
        ladder = framed_ladder(ladder, highest=limits.highest, lowest=limits.lowest, tread_px=_TREAD_PX)
    unprinted = flat((size_px, size_px), level=0)
    middle = flat((size_px, size_px), level=(limits.lowest + limits.highest) // 2)
    plain = PlannedPrint(planned[0].level, ())
    references: dict[Use, np.ndarray] = {
        "substrate": unprinted, "flat": middle, "steps": ladder, "grating": unprinted,
    }  # fmt: skip
    rows = [
        (use, 0, at, level, plain, Way(), _REFERENCES[use])
        for at, (use, level) in enumerate(references.items(), start=1)
    ]
    for number, one in enumerate(planned, start=1):
        level = one.level.numpy().astype(np.min_scalar_type(limits.highest))
        weaker = f"; the print has {one.dose:g} of the dose" if one.dose != 1 else ""
        for at, way in enumerate(one.ways, start=1):
            why = WORDS.get(way, "like the earlier prints") + weaker
            rows.append(("dataset", number, at, level, one, way, why))
    scans = [
        PlannedScan(
            id=f"N{number}F{at}",
            print=str(number),
            order=order,
            use=use,
            **vars(way),
            field_x_um=printing.reach_um(one),
            field_y_um=printing.reach_um(one),
            dose=one.dose,
            why=why,
        )
        for order, (use, number, at, _, one, way, why) in enumerate(rows)
    ]
    return scans, [level for _, _, _, level, *_ in rows]


def write_plan(folder: Path, plan: NextPrint, layouts: Sequence[np.ndarray], printing: Printing) -> None:
    """Write the card, the table, the layouts and the sheets.

    ``layouts`` contains the level map of each scan.
    """
    for scan, level in zip(plan.scans, layouts, strict=True):
        write_layout(folder, scan.id, level)
    write_table(folder, _COLUMNS, [tuple(getattr(scan, name) for name in _COLUMNS) for scan in plan.scans])
    write_card(
        folder,
        name=f"{plan.dataset.name}-next",
        title=f"Planned prints that decide the open questions on {plan.dataset.name}",
        pitch_um=printing.pitch_um,
        level_height_um=printing.level_height_um,
        levels=printing.highest + 1,
        scan_size_um=(plan.field_um, plan.field_um),
        ids={"print": PRINT_PATTERN, "table": TABLE_NAME},
        write={"slow_axis": "y", "field_um": printing.write_field_um},
        plan={"dataset_sha256": plan.dataset.sha256},
        grating={"period_um": _grating_um(plan)},
    )
    plan.write(folder)
    for name in (PRINTER_SHEET, MICROSCOPE_SHEET):
        sheet = filled(_TEMPLATES / f"{name}.jinja", plan=plan, uses=_USES, grating_um=_grating_um(plan))
        with atomic_file(folder / name) as temporary:
            temporary.write_text(sheet, encoding="utf-8")


def _grating_um(plan: NextPrint) -> float:
    return next((one for one in _PERIODS_UM if _FEWEST_PERIODS * one <= plan.field_um), _PERIODS_UM[-1])
