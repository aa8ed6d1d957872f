"""Which scans are trained on, which are held out, and which stay locked.

The unit is the whole scan, because the quadrants of one scan share its datum, tip and day. Every
choice follows from a hash of the ids and a seed: it depends on no library's random generator, so
that the same ids always give the same split.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from litho_data.foundation.errors import InputError

if TYPE_CHECKING:
    from litho_data.store import PrintedScan, Store

QUADRANTS = (0, 1, 2, 3)


@dataclass(frozen=True)
class Crop:
    """A quadrant of a scan: 0 top left, 1 top right, 2 bottom left, 3 bottom right."""

    scan_id: str
    quadrant: int

    def slices(self, shape: tuple[int, int]) -> tuple[slice, slice]:
        """Rows and columns of the quadrant in an array of ``shape`` (ny, nx)."""
        half_y, half_x = shape[0] // 2, shape[1] // 2
        row, column = divmod(self.quadrant, 2)
        return (
            slice(half_y, shape[0]) if row else slice(0, half_y),
            slice(half_x, shape[1]) if column else slice(0, half_x),
        )


def lock_box_size(scan_count: int) -> int:
    """Number of locked scans: a sixth of all, at least one; none where fewer than three scans exist."""
    return max(1, round(scan_count / 6)) if scan_count >= 3 else 0


def lock_box(ids: Sequence[str], print_ids: Sequence[str], n: int, seed: int = 0) -> list[str]:
    """Choose ``n`` scans from ``n`` different prints (a second round only where prints run out).

    Args:
        ids: scan ids; ``print_ids``: the print of each, same length.
        n: number of scans to lock.
        seed: another seed gives another choice.

    Raises:
        InputError: ids that repeat, lists of different length, or no scan left to work with.
    """
    _check_ids(ids)
    if len(print_ids) != len(ids):
        raise InputError("print_ids", got=f"{len(print_ids)} entries", wanted=f"{len(ids)}, one per scan id")
    if n >= len(ids):
        raise InputError("lock box", got=f"{n} of {len(ids)} scans", wanted="at least one scan left for work")
    by_print: dict[str, list[str]] = {}
    for scan_id, print_id in sorted(zip(ids, print_ids, strict=True), key=lambda pair: _order(pair[0], seed)):
        by_print.setdefault(print_id, []).append(scan_id)
    prints = sorted(by_print, key=lambda print_id: _order(f"print {print_id}", seed))
    chosen: list[str] = []
    for turn in range(len(ids)):
        chosen += [by_print[name][turn] for name in prints if turn < len(by_print[name])]
    return sorted(chosen[:n])


def locked_ids(scans: Sequence[PrintedScan], seed: int = 0) -> list[str]:
    """The lock box of a dataset: a sixth of its scans, from different prints."""
    ids, prints = [scan.id for scan in scans], [scan.print_id for scan in scans]
    return lock_box(ids, prints, lock_box_size(len(ids)), seed)


def grouped_folds(ids: Sequence[str], k: int = 5, seed: int = 0) -> list[list[str]]:
    """Deal the scans into ``k`` folds; each fold lists the ids held out of its training.

    Raises:
        InputError: ids that repeat, fewer than two, or ``k`` outside 2 ... number of scans.
    """
    _check_ids(ids)
    if len(ids) < 2:
        raise InputError("scans to deal into folds", got=len(ids), wanted="at least 2, one of them held out")
    if not 2 <= k <= len(ids):
        raise InputError("number of folds", got=k, wanted=f"2 to {len(ids)}, the number of scans")
    shuffled = sorted(ids, key=lambda scan_id: _order(scan_id, seed))
    return [sorted(shuffled[fold::k]) for fold in range(k)]


def leave_one_print_out(ids: Sequence[str], print_ids: Sequence[str]) -> list[list[str]]:
    """One fold per print, in the order of the print names: all its scans are held out.

    Raises:
        InputError: fewer than two prints.
    """
    _check_ids(ids)
    prints = sorted(set(print_ids))
    if len(prints) < 2:
        raise InputError("leave-one-print-out", got=f"{len(prints)} print", wanted="at least 2 prints")
    return [
        sorted(scan_id for scan_id, name in zip(ids, print_ids, strict=True) if name == held_out)
        for held_out in prints
    ]


def paper_draw(ids: Sequence[str], draw: int, held_out_fraction: float = 0.25) -> list[Crop]:
    """The crops held out in one random draw over quadrants, as in the paper (24 of 96).

    Quadrants of one scan land on both sides: leaky, for comparison with the paper only.
    """
    _check_ids(ids)
    crops = [Crop(scan_id, quadrant) for scan_id in ids for quadrant in QUADRANTS]
    shuffled = sorted(crops, key=lambda crop: _order(f"{crop.scan_id} {crop.quadrant}", draw))
    held_out = shuffled[: round(held_out_fraction * len(crops))]
    return sorted(held_out, key=lambda crop: (crop.scan_id, crop.quadrant))


def inner_validation(ids: Sequence[str], count: int, seed: int = 0) -> list[str]:
    """Training scans set aside to choose the checkpoint: ``count``, but at most a quarter of all."""
    _check_ids(ids)
    return sorted(
        sorted(ids, key=lambda scan_id: _order(f"validation {scan_id}", seed))[: min(count, len(ids) // 4)]
    )


def ids_sha256(ids: Sequence[str]) -> str:
    """Hex SHA-256 of a set of ids: sorted, one per line."""
    return hashlib.sha256("\n".join(sorted(ids)).encode()).hexdigest()


def files_sha256(store: Store, ids: Sequence[str]) -> dict[str, str]:
    """Hash of the raw file behind each of some scans, however they were levelled and registered.

    A scan whose file the store does not list is left out. Layouts do not count: one may be printed twice.
    """
    wanted = set(ids)
    rows = [row for row in store.manifest.get("files", []) if row["scan"] in wanted and row["sha256"]]
    # Only what was read as a scan has the facts of a reader.
    return {row["scan"]: row["sha256"] for row in rows if json.loads(row["read"] or "{}")}


def _order(name: str, seed: int) -> str:
    return hashlib.sha256(f"{seed}:{name}".encode()).hexdigest()


def _check_ids(ids: Sequence[str]) -> None:
    if len(set(ids)) != len(ids):
        repeated = sorted({scan_id for scan_id in ids if list(ids).count(scan_id) > 1})
        raise InputError("scan ids repeat", got=", ".join(repeated), wanted="unique ids")
