"""Divide scans into training scans and held-out scans. The locked scans are chosen elsewhere, in
``litho_data.store.lock_box``.

Except in the split ``paper``, whole scans are held out, because the quadrants of one scan have the same datum
and were measured with the same tip on the same day. Every choice follows from a hash of the scan ids and a
seed, so the same ids and the same seed always give the same split.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_data.store.lock_box import drawing_key, field_of, require_unique, scans_by_field
from litho_models.scan_terms.background import ScanPart

SplitKind = Literal["grouped", "paper", "leave-one-print-out"]
GROUPED_FOLDS = 5
QUADRANTS = (0, 1, 2, 3)


class Split(Record):
    """How a dataset is divided into folds. ``lock_box`` lists the locked scans, whether or not they were
    scored.
    """

    kind: str
    folds: int = 0
    lock_box: list[str] = Field(default_factory=list)


class ScoredSplit(Split):
    """A split, and the ids of the scans that were scored with it. ``lock_box_opened`` says whether any locked
    scan was scored.

    ``first_folds`` is the number of folds that were fitted and scored, or None if all folds were fitted and
    scored.
    """

    seed: int = 0
    first_folds: int | None = None
    scored_ids: list[str]
    scored_ids_sha256: str
    lock_box_opened: bool = False


@dataclass(frozen=True)
class Crop:
    """A quadrant of a scan: number 0 is top left, 1 top right, 2 bottom left, and 3 bottom right."""

    scan_id: str
    quadrant: int

    def slices(self, shape: tuple[int, int]) -> tuple[slice, slice]:
        """Return the slices of rows and columns that cut the quadrant out of an array of shape (ny, nx)."""
        half_y, half_x = shape[0] // 2, shape[1] // 2
        row, column = divmod(self.quadrant, 2)
        return (
            slice(half_y, shape[0]) if row else slice(0, half_y),
            slice(half_x, shape[1]) if column else slice(0, half_x),
        )


@dataclass(frozen=True)
class Fold:
    """One fold: the training scans, and the held-out scans. Models trained on the training scans predict the
    held-out scans. ``locked`` is True if the held-out scans are the locked scans.
    """

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
    """Return the folds of a split. In the split ``paper``, training and held-out sets contain quadrants of
    the same scans, and locked scans are used like all others. All other splits leave out the locked scans
    unless ``open_lock_box`` is set, in which case an additional fold holds them out.

    Raises:
        InputError: there are too few scans, there are no locked scans although ``open_lock_box`` is set, or
            the split is unknown.
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
            got=f"no locked scans, because {len(scans)} scans show too few printed fields",
            wanted="scans of at least 3 fields",
            hint="run without --open-lock-box",
        )
    development = [scan for scan in scans if scan.id not in locked]
    ids = [scan.id for scan in development]
    if split == "grouped":
        lists = grouped_folds(ids, [field_of(scan) for scan in development], folds, seed)
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


def grouped_folds(ids: Sequence[str], fields: Sequence[str], k: int = 5, seed: int = 0) -> list[list[str]]:
    """Divide scans into ``k`` folds, or into one fold per printed field if there are fewer than ``k`` fields.
    All scans of a field are in the same fold. Return, for each fold, the ids of the scans that it holds out.

    Args:
        ids: ids of the scans.
        fields: the printed field of each scan, in the same order, as ``field_of`` returns it.
        k: number of folds.
        seed: seed of the random order.

    Raises:
        InputError: an id is repeated, there are fewer than two fields, or ``k`` is below 2.
    """
    require_unique(ids)
    shuffled = scans_by_field(ids, fields, seed)
    if len(shuffled) < 2:
        raise InputError(
            "printed fields to divide into folds",
            got=len(shuffled),
            wanted="at least 2, so that one field can be held out",
            hint="scans of one print with the same layout and dose count as one field, unless the "
            "table of the card states other positions (field_x_um, field_y_um)",
        )
    if k < 2:
        raise InputError("number of folds", got=k, wanted="at least 2")
    k = min(k, len(shuffled))
    return [sorted(scan_id for scans in shuffled[fold::k] for scan_id in scans) for fold in range(k)]


def leave_one_print_out(ids: Sequence[str], print_ids: Sequence[str]) -> list[list[str]]:
    """Return one fold per print, in the order of the names of the prints. Each fold holds out all scans of
    its print, and is given as the list of the ids of these scans.

    Raises:
        InputError: there are fewer than two prints, or an id is repeated.
    """
    require_unique(ids)
    prints = sorted(set(print_ids))
    if len(prints) < 2:
        raise InputError(
            "prints for leave-one-print-out", got=f"{len(prints)} print", wanted="at least 2 prints"
        )
    return [
        sorted(scan_id for scan_id, name in zip(ids, print_ids, strict=True) if name == held_out)
        for held_out in prints
    ]


def paper_draw(ids: Sequence[str], draw: int) -> list[Crop]:
    """Choose a quarter of all quadrants at random, and return these quadrants as the held-out crops. The
    paper chooses 24 of 96 quadrants in this way.

    The training set and the held-out set both contain quadrants of the same scans, so errors are
    underestimated. Use this split only for comparison with the paper.
    """
    require_unique(ids)
    crops = [Crop(scan_id, quadrant) for scan_id in ids for quadrant in QUADRANTS]
    shuffled = sorted(crops, key=lambda crop: drawing_key(f"{crop.scan_id} {crop.quadrant}", draw))
    held_out = shuffled[: round(len(crops) / 4)]
    return sorted(held_out, key=lambda crop: (crop.scan_id, crop.quadrant))


def inner_validation(ids: Sequence[str], count: int, seed: int = 0) -> list[str]:
    """Choose the validation scans of a training, and return their ids. The error on these scans decides which
    round of the training is the best. ``count`` scans are chosen, but at most a quarter of the scans in
    ``ids``.
    """
    require_unique(ids)
    shuffled = sorted(ids, key=lambda scan_id: drawing_key(f"validation {scan_id}", seed))
    return sorted(shuffled[: min(count, len(ids) // 4)])


def _quadrant(scan: PrintedScan, crop: Crop) -> PrintedScan:
    area = crop.slices(scan.shape)
    sigma_um = scan.height_sigma_um
    cut = {
        "id": f"{scan.id}/{crop.quadrant}",
        "mask_level": scan.mask_level[area],
        "height_um": scan.height_um[area],
        "valid": scan.valid[area],
        "height_sigma_um": None if sigma_um is None else sigma_um[area],
    }
    return ScanPart(**(vars(scan) | cut), whole=scan.shape, area=area)
