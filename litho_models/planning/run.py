"""From a closed loop to the plan of the next prints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from litho_data.cards.card import Use
from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_folder
from litho_data.foundation.outputs import require_replaceable_folder, require_same_settings
from litho_data.foundation.run_facts import run_info
from litho_data.layouts.patterns import flat, framed_ladder
from litho_models.frozen.card import ModelCard
from litho_models.frozen.files import load_simulator
from litho_models.planning import answers
from litho_models.planning.designer import WORDS, Designer, as_tensor, random_level, ways_without_rivals
from litho_models.planning.folder import HOLDS, write_plan
from litho_models.planning.layouts import STEPS, Limits, assemble
from litho_models.planning.questions import OpenQuestions
from litho_models.planning.record import NextPrint, PlannedQuestion, PlannedScan
from litho_models.planning.report import write_report
from litho_models.planning.rivalry import PlannedPrint, Printing, Rivalry, Way
from litho_models.twin.run import MODEL_FOLDER

# Prints on which the rivals are compared at last; the others are made of the same tiles.
_JUDGED = 2
_FEWEST_PRINTS = 2
_SMALLEST_PX = 64


def next_print(
    loop: str | Path,
    out: str | Path,
    *,
    prints: int = 4,
    field_um: float = 51.2,
    seed: int = 0,
    steps: int = STEPS,
    layouts: Literal["optimised", "random"] = "optimised",
    cache: str | Path | None = None,
    report: Callable[[str], None] = lambda message: None,
) -> NextPrint | None:
    """Plan the prints and scans that decide what a closed loop left open; None if nothing is open.

    Args:
        loop: folder of a closed loop.
        out: folder of the plan, which appears when complete.
        prints: how many at most; ``field_um``: side of each.
        seed: of random layouts; ``steps``: of the ascent of each tile.
        layouts: ``random`` for a control: the same scans of layouts that nothing was optimised in.
        cache: folder where finished tiles are kept until the plan is there; beside ``out`` by default.
        report: told what happens, a sentence at a time.

    Raises:
        InputError: no closed loop, one from before questions were kept, prints of an impossible size, or a
            folder with a plan of other settings.
    """
    require_replaceable_folder(out, *HOLDS)
    folder = Path(loop)
    if not (folder / OpenQuestions.FILE_NAME).is_file():
        raise InputError(
            f"no {OpenQuestions.FILE_NAME} in {loop}",
            wanted="the folder of a closed loop",
            hint="litho-models close-loop writes it; results of earlier versions have none",
        )
    open_ = OpenQuestions.read(folder)
    if not open_.questions:
        return None
    asked = {"prints": prints, "field_um": field_um, "seed": seed, "steps": steps, "layouts": layouts}
    facts = {"dataset": open_.dataset.model_dump(mode="json"), "settings": asked}
    require_same_settings(out, NextPrint.FILE_NAME, facts)
    card = ModelCard.read(folder / MODEL_FOLDER)
    size_px = round(field_um / card.pitch_um)
    if size_px < _SMALLEST_PX or prints < 1:
        raise InputError(
            "size of the prints",
            got=f"{prints} of {field_um:g} µm",
            wanted=f"at least one of {_SMALLEST_PX * card.pitch_um:g} µm",
        )
    base = load_simulator(folder / MODEL_FOLDER, card)
    limits = Limits.of(open_, card.pitch_um)
    printing = Printing(card.pitch_um, card.level_height_um, card.levels - 1, open_.write_field_um)
    contested = [q for q in open_.questions if len(q.rivals) > 1]
    rivalries = [Rivalry(q, base, printing, open_.noise) for q in contested]
    designer = Designer(rivalries, limits, size_px, seed, steps, Path(cache or f"{out}-cache"), report)
    can_move = open_.write_field_um is not None and open_.write_field_um > field_um
    designer.choose(ways_without_rivals(open_.questions), can_move)
    tiles = designer.tiles(folder, prints) if layouts == "optimised" else designer.random_tiles(prints)
    levels = [assemble(tiles, number, size_px, limits) for number in range(prints)]
    orders = np.linspace(-0.5, 0.5, prints) if prints > 1 else np.zeros(1)
    planned = [
        PlannedPrint(as_tensor(level), designer.ways, designer.place(i), float(order), designer.dose(i))
        for i, (level, order) in enumerate(zip(levels, orders, strict=True))
    ]
    report("comparing the rivals on the planned prints, and on random ones")
    random = [
        replace(one, level=as_tensor(random_level(limits, size_px, seed + 101 + i)))
        for i, one in enumerate(planned[:_JUDGED])
    ]
    judged = {
        rivalry.question.name: answers.of_rivals(rivalry, planned[:_JUDGED], random, tried, prints)
        for rivalry, tried in zip(rivalries, designer.tried, strict=True)
    }
    answered = [
        judged.get(q.name) or answers.of_others(q, open_, prints, len(designer.ways), size_px)
        for q in open_.questions
    ]
    count = _fewest(answered, prints)
    planned, levels = planned[:count], levels[:count]
    scans, maps = schedule(planned, levels, limits, printing, seed)
    plan = NextPrint(
        run=run_info([seed], len(scans)),
        dataset=open_.dataset,
        settings=asked,
        prints=count,
        field_um=field_um,
        levels=(limits.lowest, limits.highest),
        cutoff_per_um=limits.cutoff_per_um,
        smallest_feature_um=0.5 / limits.cutoff_per_um,
        level_distance=_level_distance(levels, open_.level_share),
        starts=designer.chosen,
        scans=scans,
        questions=answered,
    )
    with atomic_folder(out) as target:
        write_plan(
            target,
            plan,
            maps,
            pitch_um=card.pitch_um,
            level_height_um=card.level_height_um,
            levels=card.levels,
            write_field_um=open_.write_field_um,
        )
        write_report(target, plan, levels, rivalries, planned[0])
    designer.forget()
    return plan


def _fewest(questions: Sequence[PlannedQuestion], allowed: int) -> int:
    """Prints that decide all that the allowed number decides; all where some question is left over."""
    asked = [q.prints_needed or allowed for q in questions if q.status in ("decides", "may decide")]
    # One print alone may have a defect.
    return min(allowed, max([_FEWEST_PRINTS, *asked]))


def _level_distance(levels: Sequence[np.ndarray], known: Sequence[float]) -> float:
    counts = np.bincount(np.concatenate([one.ravel() for one in levels]), minlength=len(known))
    return float(0.5 * np.abs(counts / counts.sum() - np.array(known)).sum())


_TREAD_PX = 30
_LADDER_PX = 5 * _TREAD_PX


def schedule(
    planned: Sequence[PlannedPrint],
    levels: Sequence[np.ndarray],
    limits: Limits,
    printing: Printing,
    seed: int,
) -> tuple[list[PlannedScan], list[np.ndarray]]:
    """The rows of the table, and the layout of each."""
    size_px = levels[0].shape[0]
    # A stair alone looks the same wherever it is shifted; without room for a frame it is left to chance.
    ladder = random_level(limits, size_px, seed + 13)
    if size_px >= _LADDER_PX:
        ladder = framed_ladder(ladder, highest=limits.highest, lowest=limits.lowest, tread_px=_TREAD_PX)
    unprinted = np.zeros((size_px, size_px), np.uint8)
    references: list[tuple[Use, np.ndarray, str]] = [
        ("substrate", unprinted, "zero, tilt and bow without a print"),
        ("flat", flat((size_px, size_px), level=(limits.lowest + limits.highest) // 2), "the noise floor"),
        ("steps", ladder, "height against level; on a step standard of known height the microscope's gain"),
        ("grating", unprinted, "scales and unevenness of the scanner, and the tip"),
    ]
    rows: list[tuple[str, str, Use, Way, float, float, str, np.ndarray]] = []
    for number, (use, level, why) in enumerate(references, start=1):
        rows.append((f"N0F{number}", "0", use, Way(), 0.0, 1.0, why, level))
    for number, (one, level) in enumerate(zip(planned, levels, strict=True), start=1):
        reach_um = 0.0
        if one.place == "edge" and printing.write_field_um is not None:
            reach_um = (printing.write_field_um - size_px * printing.pitch_um) / 2
        for at, way in enumerate(one.ways, start=1):
            why = WORDS.get(way, "as the prints so far").split(":")[0]
            if one.dose != 1:
                why += f"; the print has {one.dose:g} of the dose"
            rows.append((f"N{number}F{at}", str(number), "dataset", way, reach_um, one.dose, why, level))
    scans = [
        PlannedScan(
            id=scan_id,
            print=block,
            order=order,
            use=use,
            turned_deg=way.turned_deg,
            direction=-1 if way.backward else 1,
            tip=2 if way.new_tip else 1,
            pixel_size=way.pixel_size,
            field_x_um=reach_um,
            field_y_um=reach_um,
            dose=dose,
            why=why,
        )
        for order, (scan_id, block, use, way, reach_um, dose, why, _) in enumerate(rows)
    ]
    return scans, [row[-1] for row in rows]
