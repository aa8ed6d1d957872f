"""The plan as a folder: a dataset in waiting, with a sheet for the printer and one for the microscope."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from litho_data.cards.card import Use
from litho_data.foundation.files import atomic_file
from litho_data.layouts.card_text import TABLE_NAME, write_card, write_layout, write_table
from litho_data.layouts.patterns import flat, framed_ladder
from litho_models.planning.designer import WORDS
from litho_models.planning.layouts import Limits
from litho_models.planning.record import NextPrint, PlannedScan
from litho_models.planning.rivalry import PlannedPrint, Printing, Way

PRINT_PATTERN = r"N(?P<print>\d+)F\d+"
PRINTER_SHEET, MICROSCOPE_SHEET = "printer.md", "microscope.md"
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
# What the printer makes of them.
_USES = {
    "substrate": "bare substrate, nothing printed: zero, tilt and bow of the microscope",
    "flat": "one level everywhere: the noise floor",
    "steps": "a stair: height against level",
}
# Periods that are sold, µm; of fewer than so many in a field the period is not found.
_PERIODS_UM, _FEWEST_PERIODS = (10.0, 5.0, 3.0, 2.0, 1.0), 8


_TREAD_PX = 30
_LADDER_PX = 5 * _TREAD_PX


def schedule(
    planned: Sequence[PlannedPrint], limits: Limits, printing: Printing, seed: int
) -> tuple[list[PlannedScan], list[np.ndarray]]:
    """The rows of the table, and the layout of each."""
    size_px = len(planned[0].level)
    # A stair alone looks the same wherever it is shifted; without room for a frame it is left to chance.
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
        level = one.level.numpy().astype(np.uint8)
        weaker = f"; the print has {one.dose:g} of the dose" if one.dose != 1 else ""
        for at, way in enumerate(one.ways, start=1):
            why = WORDS.get(way, "as the prints so far") + weaker
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
    """Write card, table, layouts and sheets; ``layouts``: the level map of each scan."""
    for scan, level in zip(plan.scans, layouts, strict=True):
        write_layout(folder, scan.id, level)
    write_table(folder, _COLUMNS, [tuple(getattr(scan, name) for name in _COLUMNS) for scan in plan.scans])
    write_card(
        folder,
        name=f"{plan.dataset.name}-next",
        title=f"Planned prints that decide what is open on {plan.dataset.name}",
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
    for name, lines in ((PRINTER_SHEET, _printer_sheet(plan)), (MICROSCOPE_SHEET, _microscope_sheet(plan))):
        with atomic_file(folder / name) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _grating_um(plan: NextPrint) -> float:
    return next((one for one in _PERIODS_UM if _FEWEST_PERIODS * one <= plan.field_um), _PERIODS_UM[-1])


def _printer_sheet(plan: NextPrint) -> list[str]:
    printed = [scan for scan in plan.scans if scan.use in _USES or scan.id.endswith("F1")]
    return [
        f"# Printing for {plan.dataset.name}",
        "",
        f"{plan.prints} prints of {plan.field_um:g} µm, in this order, with the resist and recipe of the "
        "prints so far, none turned. Write along x, one line below the other. Print the references once.",
        "",
        "| order | layout | centre in the write field (x, y), µm | dose, of the recipe's | what it is |",
        "|---|---|---|---|---|",
        *(
            f"| {scan.order} | layouts/{scan.id}.tif | {scan.field_x_um:g}, {scan.field_y_um:g} | "
            f"{scan.dose:g} | {_USES.get(scan.use, 'print')} |"
            for scan in printed
        ),
        "",
        "Dose is what the resist takes up: with two photons it goes with the square of the laser power, so "
        "that 0.8 of it takes 0.89 of the power.",
        "Note the laser power before each print, and anything that went otherwise than written here.",
    ]


def _microscope_sheet(plan: NextPrint) -> list[str]:
    return [
        f"# Scanning for {plan.dataset.name}",
        "",
        f"{len(plan.scans)} scans in this order. Save raw heights, not levelled, one file per scan: "
        "`scans/ID.txt`, heights in metres (or change `[scan]` of `card.toml` to your format and size). A "
        "margin of 1 to 2 µm around the print helps. Take the print out and put it back between two scans of "
        "it. Leave the file as the microscope shows it: do not turn it back.",
        "",
        f"The grating is a standard, no print: a square one of {_grating_um(plan):g} µm, or another of which "
        "eight periods fit into a scan, laid along the axes of the scan. Put its period and its uncertainty "
        "into `[grating]` of `card.toml` (`period_um`, `uncertainty_um`). Without one leave its file out.",
        "",
        "| order | scan | print | turned | direction | tip | pixels | why |",
        "|---|---|---|---|---|---|---|---|",
        *(
            f"| {scan.order} | {scan.id} | {scan.print} | {scan.turned_deg}° | "
            f"{'there' if scan.direction > 0 else 'back'} | {'as before' if scan.tip == 1 else 'new'} | "
            f"{'as before' if scan.pixel_size == 1 else f'{scan.pixel_size:g} of their size'} | {scan.why} |"
            for scan in plan.scans
        ),
        "",
        "If a scan had to be made otherwise, say so in `scans.csv` (`turned_deg`, `direction`, `tip`, "
        "`pixel_size`): a turned scan without its column is refused. Then",
        "",
        "    litho-data build card.toml --out next.zarr",
        "    litho-models close-loop prints.zarr next.zarr --out decided",
    ]
