"""Plan the next prints from a closed loop."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from litho_data.foundation.begun import whole_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import record_sha256
from litho_data.foundation.run_facts import run_info
from litho_models.frozen.card import ModelCard
from litho_models.frozen.files import load_simulator
from litho_models.loop.run import MODEL_FOLDER
from litho_models.planning.answers import of_others, of_rivals
from litho_models.planning.folder import HOLDS, schedule, write_plan
from litho_models.planning.layouts import (
    STEPS,
    TILE_PX,
    TURNED,
    Limits,
    as_tensor,
    assemble,
    choose,
    climbed,
    together,
)
from litho_models.planning.questions import OpenQuestions
from litho_models.planning.record import NextPrint
from litho_models.planning.report import write_report
from litho_models.planning.rivalry import PlannedPrint, Printing, Rivalry

# Number of prints for the final comparison of rivals; further prints repeat the same tiles.
_JUDGED = 2
_FEWEST_PRINTS, _TILES = 2, 4
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
    report: Callable[[str], None] = lambda message: None,
) -> NextPrint | None:
    """Plan prints and scans that decide the open questions of a closed loop; return None if no question is
    open.

    Args:
        loop: folder of a closed loop.
        out: folder of the plan, which appears only when the plan is complete.
        prints: largest number of prints.
        field_um: side length of each print.
        seed: seed of the random layouts.
        steps: number of ascent steps for each tile.
        layouts: ``random`` plans the same scans with random layouts, as a control.
        report: function that receives the progress messages.

    Raises:
        InputError: there is no closed loop, the prints have an impossible size, or the folder contains a plan
            with other settings.
    """
    folder = Path(loop)
    if not (folder / OpenQuestions.FILE_NAME).is_file():
        raise InputError(
            f"no {OpenQuestions.FILE_NAME} in {loop}",
            wanted="the folder of a closed loop",
            hint="litho-models close-loop writes this file",
        )
    open_ = OpenQuestions.read(folder)
    if not open_.questions:
        return None
    asked = {"prints": prints, "field_um": field_um, "seed": seed, "steps": steps, "layouts": layouts}
    facts = {"dataset": open_.dataset.model_dump(mode="json"), "settings": asked}
    card = ModelCard.read(folder / MODEL_FOLDER)
    size_px = round(field_um / card.pitch_um)
    if size_px < _SMALLEST_PX or prints < 1:
        raise InputError(
            "planned prints",
            got=f"{prints} of {field_um:g} µm",
            wanted=f"at least one print with a side of at least {_SMALLEST_PX * card.pitch_um:g} µm",
        )
    with whole_folder(out, *HOLDS, record=NextPrint.FILE_NAME, facts=facts) as target:
        base = load_simulator(folder / MODEL_FOLDER, card)
        limits = Limits.of(open_, card.pitch_um)
        printing = Printing(card.pitch_um, card.level_height_um, card.levels - 1, open_.write_field_um)
        rivalries = [Rivalry(one, base, printing, open_.noise) for one in open_.questions if one.rivals]
        tile_px = min(TILE_PX, size_px)
        can_move = open_.write_field_um is not None and open_.write_field_um > field_um
        choices = [choose(rivalry, limits.random(tile_px, seed), can_move) for rivalry in rivalries]
        # A scan rotated by 90 degrees is also a repeat, because the print was remounted.
        turned = (TURNED,) if any(one.kind in ("lines", "per-scan") for one in open_.questions) else ()
        chosen = together(choices, turned)
        count = _TILES if size_px > tile_px else prints
        tiles, starts = [limits.random(tile_px, seed + 31 + i) for i in range(count)], ["random"]
        # The finished tiles of an interrupted run are stored here.
        cache = Path(f"{out}-cache")
        if rivalries and layouts == "optimised":
            kept = cache / record_sha256({**open_.model_dump(mode="json"), **asked})[:16]
            tiles, starts = climbed(
                rivalries, chosen, limits, tile_px, count, seed=seed, steps=steps, kept=kept, report=report
            )
        planned = [
            PlannedPrint(
                as_tensor(assemble(tiles, number, size_px, limits)),
                chosen.ways,
                chosen.places[number % len(chosen.places)],
                number / max(prints - 1, 1) - 0.5,
                chosen.doses[number % len(chosen.doses)],
            )
            for number in range(prints)
        ]
        report("comparing the rivals on the planned prints, and on random ones")
        judged = planned[:_JUDGED]
        random = [
            replace(one, level=as_tensor(limits.random(size_px, seed + 101 + i)))
            for i, one in enumerate(judged)
        ]
        answered = {
            rivalry.question.name: of_rivals(rivalry, choice.tried, judged, random, prints)
            for rivalry, choice in zip(rivalries, choices, strict=True)
        }
        questions = [
            answered.get(one.name) or of_others(one, open_, prints, len(chosen.ways), size_px)
            for one in open_.questions
        ]
        needed = [q.prints_needed or prints for q in questions if q.status in ("decides", "may decide")]
        # A single print may have a defect.
        planned = planned[: max([_FEWEST_PRINTS, *needed])]
        scans, maps = schedule(planned, limits, printing, seed)
        levels = np.stack([one.level.numpy() for one in planned]).astype(int)
        share = np.bincount(levels.ravel(), minlength=card.levels) / levels.size
        plan = NextPrint(
            run=run_info([seed], len(scans)),
            dataset=open_.dataset,
            settings=asked,
            prints=len(planned),
            field_um=field_um,
            levels=(limits.lowest, limits.highest),
            cutoff_per_um=limits.cutoff_per_um,
            smallest_feature_um=0.5 / limits.cutoff_per_um,
            level_distance=float(0.5 * np.abs(share - open_.level_share).sum()),
            starts=starts,
            scans=scans,
            questions=questions,
        )
        write_plan(target, plan, maps, printing)
        write_report(target, plan, rivalries, planned)
    shutil.rmtree(cache, ignore_errors=True)
    return plan
