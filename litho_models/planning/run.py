"""Plan the next prints from a closed loop.

The plan is a folder. It contains a dataset in which only the scans are still missing, and instruction sheets
for the people who operate the printer and the microscope.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import torch

from litho_data.cards.card import Use
from litho_data.foundation import Array, InputError, record_sha256
from litho_data.foundation.begun import whole_folder
from litho_data.foundation.run_facts import run_info
from litho_data.layouts.card_text import TABLE_NAME, write_card, write_layout, write_table
from litho_data.layouts.patterns import flat, framed_ladder
from litho_data.reports.page import filled
from litho_models.effects import FieldContext
from litho_models.frozen.card import ModelCard
from litho_models.frozen.files import load_simulator
from litho_models.loop.run import MODEL_FOLDER
from litho_models.planning.answers import COUNTS, of_others, of_rivals
from litho_models.planning.layouts import Limits, assemble, choose, climbed, starts, together
from litho_models.planning.questions import OpenQuestions
from litho_models.planning.record import NextPrint, PlannedScan
from litho_models.planning.report import write_report
from litho_models.planning.rivalry import TURNED, Print, Rivalry
from litho_models.simulator import SimulatorConfig

# Number of planned prints on which the rivals (competing explanations) are finally compared. More prints are
# not needed for this comparison, because they consist of the same tiles.
_JUDGED = 2
_FEWEST_PRINTS, _TILES = 2, 4
_TILE_PX, _SMALLEST_PX = 256, 64
PRINT_PATTERN = r"N(?P<print>\d+)F\d+"
PRINTER_SHEET, MICROSCOPE_SHEET = "printer.md", "microscope.md"
HOLDS = (
    "card.toml",
    "scans.csv",
    "layouts/*.tif",
    NextPrint.FILE_NAME,
    "report.html",
    "*.csv",
    PRINTER_SHEET,
    MICROSCOPE_SHEET,
)
_REFERENCES = {
    "substrate": "shows zero, tilt and bow without a print",
    "flat": "shows the noise floor",
    "steps": "shows the height of each level; on a step standard, the gain of the microscope",
    "grating": "shows the lateral scales and the uneven motion of the scanner, and the tip",
}
# ``_PERIODS_UM``: periods of commercial gratings, µm. ``_FEWEST_PERIODS``: smallest number of periods that a
# scan must contain.
_PERIODS_UM, _FEWEST_PERIODS = (10.0, 5.0, 3.0, 2.0, 1.0), 8
_TREAD_PX = 30
_LADDER_PX = 5 * _TREAD_PX


def next_print(
    loop: str | Path,
    out: str | Path,
    *,
    prints: int = 4,
    field_um: float = 51.2,
    seed: int = 0,
    steps: int = 40,
    layouts: Literal["optimised", "random"] = "optimised",
    report: Callable[[str], None] = lambda message: None,
) -> NextPrint | None:
    """Plan prints and scans that decide the open questions of a closed loop. Write the plan to the folder
    ``out`` and return its record. Return None if no question is open.

    Args:
        loop: folder with the result of a closed loop.
        out: folder of the plan. It appears only when the plan is complete.
        prints: largest number of prints.
        field_um: side length of each print, µm.
        seed: seed of the random layouts.
        steps: number of gradient-ascent steps by which each tile is optimised.
        layouts: ``optimised`` for optimised layouts, or ``random`` for the same scans with random layouts,
            which serve as a control.
        report: function that receives the progress messages.

    Raises:
        InputError: ``loop`` contains no closed loop on scans of heights, the layouts of the earlier prints
            have only one level, ``prints`` is not between 1 and 12, ``field_um`` is too small, or ``out``
            contains a plan with other settings.
    """
    if not (Path(loop) / OpenQuestions.FILE_NAME).is_file():
        raise InputError(
            f"no {OpenQuestions.FILE_NAME} in {loop}",
            wanted="the folder of a closed loop",
            hint="litho-models close-loop writes this file",
        )
    open_ = OpenQuestions.read(Path(loop))
    if not open_.questions:
        return None
    if open_.instrument == "sem":
        raise InputError(
            f"closed loop in {loop}", got="electron micrographs of films", wanted="scans of heights"
        )
    asked = {"prints": prints, "field_um": field_um, "seed": seed, "steps": steps, "layouts": layouts}
    facts = {"dataset": open_.dataset.model_dump(mode="json"), "settings": asked}
    model = Path(loop) / MODEL_FOLDER
    base = load_simulator(model, ModelCard.read(model))
    geometry = base.config
    size_px = round(field_um / geometry.pitch_um)
    if size_px < _SMALLEST_PX or prints not in COUNTS:
        raise InputError(
            "planned prints",
            got=f"{prints} of {field_um:g} µm",
            wanted=f"1 to {max(COUNTS)} prints with a side of at least "
            f"{_SMALLEST_PX * geometry.pitch_um:g} µm",
        )
    with whole_folder(out, *HOLDS, record=NextPrint.FILE_NAME, facts=facts) as target:
        limits = Limits.of(open_, geometry.pitch_um)
        plain = FieldContext(
            torch.zeros(1, 1, size_px, size_px),
            geometry.pitch_um,
            geometry.full_height_um,
            geometry.level_height_um,
            field_radius_um=open_.write_field_um and open_.write_field_um / 2,
            slow_axis=open_.slow_axis,
        )
        rivalries = {one.name: Rivalry(one, base, open_.noise) for one in open_.questions if one.rivals}
        tile_px = min(_TILE_PX, size_px)
        first = limits.random(tile_px, seed)
        choices = {name: choose(rivalry, first, plain) for name, rivalry in rivalries.items()}
        # A scan rotated by 90 degrees is also a repeated scan, because the print is remounted for it.
        repeated = any(one.kind in ("lines", "per-scan") for one in open_.questions)
        chosen = together(choices.values(), [TURNED] * repeated)
        count = _TILES if size_px > tile_px else prints
        # The finished tiles of an interrupted run are stored here.
        cache = Path(f"{out}-cache")
        if rivalries and layouts == "optimised":
            kept = cache / record_sha256({**open_.model_dump(mode="json"), **asked})[:16]
            starting = starts(tile_px, limits, seed)
            every = [*rivalries.values()]
            tiles = climbed(
                every, chosen, starting, limits, plain, count, steps=steps, kept=kept, report=report
            )
        else:
            tiles = [limits.random(tile_px, seed + 31 + i) for i in range(count)]
        levels = [assemble(tiles, number, size_px, limits) for number in range(prints)]
        planned = chosen.prints(levels, plain, prints)
        report("comparing the rivals on the planned prints, and on random ones")
        judged = planned[:_JUDGED]
        unplanned = [limits.random(size_px, seed + 101 + i) for i in range(len(judged))]
        random = chosen.prints(unplanned, plain, prints)
        questions = [
            of_rivals(rivalries[one.name], choices[one.name].tried, judged, random, prints)
            if one.rivals
            else of_others(one, open_, prints, len(chosen.ways), size_px)
            for one in open_.questions
        ]
        needed = [q.prints_needed or prints for q in questions if q.status in ("decides", "may decide")]
        # At least two prints are planned, because a single print may have a defect.
        planned = planned[: max([_FEWEST_PRINTS, *needed])]
        levels = levels[: len(planned)]
        scans, maps = schedule(planned, levels, chosen.ways, limits, plain, seed)
        plan = NextPrint(
            run=run_info([seed], len(scans)),
            dataset=open_.dataset,
            settings=asked,
            prints=len(planned),
            field_um=field_um,
            levels=(limits.lowest, limits.highest),
            scans=scans,
            questions=questions,
        )
        write_plan(target, plan, maps, geometry, open_)
        write_report(target, plan, levels, rivalries, planned[0][-1])
    shutil.rmtree(cache, ignore_errors=True)
    return plan


def schedule(
    planned: Sequence[Print],
    levels: Sequence[Array],
    ways: Sequence[str],
    limits: Limits,
    plain: FieldContext,
    seed: int,
) -> tuple[list[PlannedScan], list[Array]]:
    """Return the planned scans, which are the rows of the table ``scans.csv``, and the level map of each
    scan. The scans of the references (substrate, flat, steps and grating) come first. Without room or levels
    for three steps, there is no reference with steps.
    """
    size_px, lowest, highest = len(levels[0]), limits.lowest, limits.highest
    unprinted = flat((size_px, size_px), level=0)
    references: dict[Use, Array] = {
        "substrate": unprinted,
        "flat": flat((size_px, size_px), level=(lowest + highest) // 2),
    }
    if size_px >= _LADDER_PX and highest - lowest > 1:
        # A staircase looks the same when it is shifted, so its position could not be determined. It is
        # therefore surrounded by a random frame.
        frame = limits.random(size_px, seed + 13)
        references["steps"] = framed_ladder(frame, highest=highest, lowest=lowest, tread_px=_TREAD_PX)
    references["grating"] = unprinted
    groups = [[(use, plain, _REFERENCES[use]) for use in references]]
    groups += [[("dataset", *one) for one in zip(own, ways, strict=True)] for own in planned]
    scans: list[PlannedScan] = []
    for number, group in enumerate(groups):
        for at, (use, scan, why) in enumerate(group, start=1):
            y_um, x_um = scan.field_centre_um
            scans.append(
                PlannedScan(
                    id=f"N{number}F{at}",
                    print=str(number),
                    order=len(scans),
                    use=use,
                    turned_deg=90 * scan.quarter_turns,
                    direction=-1 if scan.backward else 1,
                    tip=2 if scan.new_tip else 1,
                    pixel_size=scan.pixel_size,
                    field_x_um=x_um,
                    field_y_um=y_um,
                    dose=scan.dose,
                    why=why + f"; the print has {scan.dose:g} of the dose" * (scan.dose != 1),
                )
            )
    return scans, [*references.values(), *(level for level in levels for _ in ways)]


def write_plan(
    folder: Path, plan: NextPrint, layouts: Sequence[Array], geometry: SimulatorConfig, open_: OpenQuestions
) -> None:
    """Write the files of a plan: the dataset card, the table of scans, the layouts, the record, and the
    sheets for printer and microscope.

    Args:
        folder: folder of the plan.
        plan: the record.
        layouts: the level map of each scan.
        geometry: configuration of the base model, which states the pitch and the levels of the prints.
        open_: the open questions of the closed loop.
    """
    for scan, level in zip(plan.scans, layouts, strict=True):
        write_layout(folder, scan.id, level)
    rows = [scan.model_dump(exclude={"print", "why"}) for scan in plan.scans]
    write_table(folder, [*rows[0]], [[*row.values()] for row in rows])
    grating_um = next((one for one in _PERIODS_UM if _FEWEST_PERIODS * one <= plan.field_um), _PERIODS_UM[-1])
    write_card(
        folder,
        name=f"{plan.dataset.name}-next",
        title=f"Planned prints that decide the open questions on {plan.dataset.name}",
        pitch_um=geometry.pitch_um,
        level_height_um=geometry.level_height_um,
        levels=geometry.levels,
        scan_size_um=(plan.field_um, plan.field_um),
        ids={"print": PRINT_PATTERN, "table": TABLE_NAME},
        instrument=open_.instrument,
        write={
            "slow_axis": open_.slow_axis,
            "field_um": open_.write_field_um,
            "surround": open_.surround,
        },
        plan={"dataset_sha256": plan.dataset.sha256},
        grating={"period_um": grating_um},
    )
    plan.write(folder)
    for name in (PRINTER_SHEET, MICROSCOPE_SHEET):
        template = Path(__file__).with_name(f"{name}.jinja")
        text = filled(template, plan=plan, grating_um=grating_um, slow_axis=open_.slow_axis)
        (folder / name).write_text(text, encoding="utf-8")
