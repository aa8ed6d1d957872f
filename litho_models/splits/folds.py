"""The folds of a benchmark: which scans are learned from and which are predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan
from litho_models.splits.splits import QUADRANTS, Crop, grouped_folds, leave_one_print_out, paper_draw

SplitKind = Literal["grouped", "paper", "leave-one-print-out"]
GROUPED_FOLDS = 5


@dataclass(frozen=True)
class Fold:
    """Scans to learn from and scans to predict; ``locked`` marks the opening of the lock box."""

    number: int
    training: list[PrintedScan]
    held_out: list[PrintedScan]
    locked: bool = False


def plan_folds(
    scans: Sequence[PrintedScan],
    locked: Sequence[str],
    split: SplitKind,
    *,
    folds: int = GROUPED_FOLDS,
    seed: int = 0,
    open_lock_box: bool = False,
) -> list[Fold]:
    """The folds of a split; scans of the lock box are in none of them, except in the leaky ``paper``.

    Raises:
        InputError: too few scans, a lock box to open where there is none, or an unknown split.
    """
    if split == "paper":
        held_out = paper_draw([scan.id for scan in scans], seed)
        crops = [(Crop(scan.id, quadrant), scan) for scan in scans for quadrant in QUADRANTS]
        parts = {crop: _quadrant(scan, crop) for crop, scan in crops}
        training = [part for crop, part in parts.items() if crop not in held_out]
        return [Fold(0, training, [parts[crop] for crop in held_out])]
    if open_lock_box and not locked:
        raise InputError(
            "lock box to open",
            got=f"none: {len(scans)} scans are too few for one",
            wanted="at least 3 scans",
            hint="leave out --open-lock-box",
        )
    development = [scan for scan in scans if scan.id not in locked]
    ids = [scan.id for scan in development]
    if split == "grouped":
        lists = grouped_folds(ids, min(folds, len(ids)), seed)
    elif split == "leave-one-print-out":
        lists = leave_one_print_out(ids, [scan.print_id for scan in development])
    else:
        raise InputError("split", got=repr(split), wanted="grouped, paper, leave-one-print-out")
    plan = [
        Fold(
            number,
            [scan for scan in development if scan.id not in held_out],
            [scan for scan in development if scan.id in held_out],
        )
        for number, held_out in enumerate(lists)
    ]
    if open_lock_box:
        plan.append(Fold(len(plan), development, [scan for scan in scans if scan.id in locked], locked=True))
    return plan


def _quadrant(scan: PrintedScan, crop: Crop) -> PrintedScan:
    area = crop.slices(scan.shape)
    return replace(
        scan,
        id=f"{scan.id}/{crop.quadrant}",
        mask_level=scan.mask_level[area],
        height_um=scan.height_um[area],
        valid=scan.valid[area],
    )
