"""The order of scanning: references, then every print with its scans, then what is scanned once more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_data.cards.card import Use
from litho_data.layouts.patterns import flat, framed_ladder
from litho_models.planning.designer import random_level
from litho_models.planning.layouts import Limits
from litho_models.planning.record import PlannedQuestion, PlannedScan
from litho_models.planning.rivalry import PlannedPrint, Printing, Way
from litho_models.planning.ways import WORDS

_TREAD_PX = 30
_LADDER_PX = 5 * _TREAD_PX


def schedule(
    planned: Sequence[PlannedPrint],
    levels: Sequence[np.ndarray],
    questions: Sequence[PlannedQuestion],
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
    references: list[tuple[Use, np.ndarray, str]] = [
        ("substrate", np.zeros((size_px, size_px), np.uint8), "zero, tilt and bow without a print"),
        ("flat", flat((size_px, size_px), level=(limits.lowest + limits.highest) // 2), "the noise floor"),
        ("steps", ladder, "height against level; on a step standard of known height the microscope's gain"),
    ]
    rows: list[tuple[str, str, Use, Way, float, str, np.ndarray]] = []
    for number, (use, level, why) in enumerate(references, start=1):
        rows.append((f"N0F{number}", "0", use, Way(), 0.0, why, level))
    for number, (one, level) in enumerate(zip(planned, levels, strict=True), start=1):
        reach_um = 0.0
        if one.place == "edge" and printing.write_field_um is not None:
            reach_um = (printing.write_field_um - size_px * printing.pitch_um) / 2
        for at, way in enumerate(one.ways, start=1):
            why = WORDS.get(way, "as the prints so far").split(":")[0]
            rows.append((f"N{number}F{at}", str(number), "dataset", way, reach_um, why, level))
    if any(q.kind == "generic" and "early print" in q.why for q in questions):
        why = "the first print once more at the end: what changed in between is the microscope's"
        rows.append((f"N1F{len(planned[0].ways) + 1}", "1", "dataset", Way(), 0.0, why, levels[0]))
    scans = [
        PlannedScan(
            id=scan_id,
            print=block,
            order=order,
            use=use,
            turned_deg=way.turned_deg,
            direction=-1 if way.backward else 1,
            tip=2 if way.new_tip else 1,
            field_x_um=reach_um,
            field_y_um=reach_um,
            why=why,
        )
        for order, (scan_id, block, use, way, reach_um, why, _) in enumerate(rows)
    ]
    return scans, [row[-1] for row in rows]
