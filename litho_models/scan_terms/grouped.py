"""Ridge regression over scans. The regressors are called columns, and their coefficients are called
strengths. A strength is either the same in all scans or differs between groups of scans.

The regression needs only the inner products of the residual and the columns of each scan. From these
products, it can compute the best-fitting strengths for any selection of scans, and the squared error that
these strengths leave in any other scans.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from litho_data.store import PrintedScan

Labels = tuple[str, ...]
ALL = "all"
# Smallest number of scans in a group. If a group had only one scan, an effect of the group could not be
# distinguished from an effect of this scan alone.
FEWEST_IN_GROUP = 2
_STATED = ("tip", "direction", "turned_deg")


def label_of(scan: PrintedScan, by: str) -> str:
    """Return the label of a scan in a grouping, i.e. the name of the group to which the scan belongs. The
    label is empty if the scan belongs to no group of this grouping.

    Args:
        by: name of the grouping, as in the result of ``groupings``.
    """
    if by == ALL:
        return ""
    if by in scan.groups:
        return scan.groups[by]
    if by == "print":
        return scan.print_id
    if by in _STATED:
        stated = getattr(scan, by)
        return "" if stated is None else f"{stated:g}"
    # Names of groups in the card contain no spaces.
    match by.split():
        case ["order", positions]:
            last, first = map(int, positions.split("-"))
            # For a scan between these positions, it is not known whether it lies before or after the change.
            return "before" if scan.order <= last else "from there on" if scan.order >= first else ""
        case ["character", position]:
            return scan.id[int(position) - 1 : int(position)]
    return ""


def groupings(scans: Sequence[PrintedScan], *, by_order: bool = True) -> dict[str, Labels]:
    """Return all groupings of the scans, keyed by name, with ``all`` first. Each grouping is a tuple of
    labels, one per scan, in the order of ``scans``.

    Groupings are derived from the dataset card. It states the print, tip, direction and rotation of each
    scan, and may define further groups. If all scan ids have the same length, groupings are also derived from
    the ids: for each position in the id, scans with the same character at this position form a group. With
    ``by_order``, groupings are also derived from the printing order. Such a grouping divides the scans into
    those before and those after a position at which something may have changed. All groupings except ``all``
    and those from the printing order must have at least two labels, and at least half of these labels must
    have two or more scans. If two groupings divide the scans in the same way, only the first is used.
    """
    stated = list(dict.fromkeys(name for scan in scans for name in scan.groups))
    names = [*stated, "print", *_STATED]
    if len({len(scan.id) for scan in scans}) == 1:
        names += [f"character {at}" for at in range(1, len(scans[0].id) + 1)]
    found: dict[str, Labels] = {ALL: ("",) * len(scans)}

    def add(names: Iterable[str]) -> None:
        for name in names:
            labels = tuple(label_of(scan, name) for scan in scans)
            counts = Counter(labels).values()
            grouped = 1 < len(counts) <= 2 * sum(count >= FEWEST_IN_GROUP for count in counts)
            if grouped and _division(labels) not in map(_division, found.values()):
                found[name] = labels

    add(names)
    if by_order:
        add(f"order {last}-{first}" for last, first in _places(scans, "print" in found))
    return found


def _division(labels: Labels) -> list[int]:
    """Return, for each scan, the index of the first scan with the same label. Groupings that divide the scans
    in the same way have the same result, whatever the names of their labels.
    """
    return [*map(labels.index, labels)]


def _places(scans: Sequence[PrintedScan], by_print: bool) -> list[tuple[int, int]]:
    """Return the places in the printing order at which something may have changed. Each place is given by the
    positions of the last scan before it and of the first scan after it. If it is known which scan belongs to
    which print, these are the places between prints. Otherwise, they are all places with at least two
    positions before and two positions after them.
    """
    places = [*pairwise(sorted({scan.order for scan in scans}))]
    if not by_print:
        return places[FEWEST_IN_GROUP - 1 : 1 - FEWEST_IN_GROUP]
    prints = {scan.print_id for scan in scans}
    firsts = {min(scan.order for scan in scans if scan.print_id == own) for own in prints}
    return [place for place in places if place[1] in firsts]


# Strengths of a block's columns, keyed by the label of a group.
Strengths = dict[str, np.ndarray]
# A small number that is added to the unit diagonal of the scaled normal equations, so that they can be solved
# even if columns are equal.
_ALIKE = 1e-7


@dataclass(frozen=True)
class Block:
    """A set of columns whose strengths share one grouping and one prior.

    Attributes:
        columns: indices of the columns in the inner products, counted from 1, because index 0 is the
            residual.
        by: name of the grouping. Each label of the grouping has separate strengths.
        shrinking: weight of the prior, which pulls the strengths towards zero. The prior weighs as much as
            this number of scans; 0 means that there is no prior.
    """

    columns: tuple[int, ...]
    by: str = ALL
    shrinking: float = 0.0


@dataclass(frozen=True)
class Products:
    """The inner products of the residual and the m columns in each scan, and the groups of the scans.

    Attributes:
        grams: inner products divided by the number of pixels, of shape (scans, 1 + m, 1 + m). Index 0 stands
            for the residual, and the other indices for the columns.
        groups: labels of all scans, keyed by the name of the grouping.
    """

    grams: np.ndarray
    groups: Mapping[str, Labels]

    @classmethod
    def ungrouped(cls, grams: np.ndarray) -> Products:
        """Make products for scans without groups. Every column then has a single strength for all scans."""
        return cls(grams, {ALL: ("",) * len(grams)})

    def strengths(self, blocks: Sequence[Block], scans: np.ndarray) -> list[Strengths]:
        """Fit the strengths to the scans with the given indices, and return them. The result is a list with
        one dictionary per block. Each dictionary maps a label to an array of strengths, of shape (columns,).

        Labels that do not occur among these scans are absent from the dictionaries.
        """
        if not blocks:
            return []
        # Scans with the same label in every grouping share all unknowns, so their products are added up.
        alike: dict[Labels, list[int]] = {}
        for scan in scans:
            alike.setdefault(tuple(self.groups[block.by][scan] for block in blocks), []).append(scan)
        usual = np.einsum("sii->si", self.grams)[scans].sum(axis=0) / max(len(scans), 1)
        rows: list[dict[str, np.ndarray]] = [{} for _ in blocks]
        shrunk: list[float] = []
        for number, (own, block) in enumerate(zip(rows, blocks, strict=True)):
            for label in sorted({labels[number] for labels in alike}):
                own[label] = len(shrunk) + np.arange(len(block.columns))
                shrunk += [block.shrinking * usual[column] for column in block.columns]
        columns = [column for block in blocks for column in block.columns]
        matrix, right = np.diag(shrunk), np.zeros(len(shrunk))
        for labels, members in alike.items():
            at = np.concatenate([own[label] for own, label in zip(rows, labels, strict=True)])
            # To take rows and then columns is several times as fast as ``np.ix_``.
            gram = self.grams[members].sum(axis=0).take(columns, axis=0)
            matrix[np.ix_(at, at)] += gram.take(columns, axis=1)
            right[at] += gram[:, 0]
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        normal = matrix / np.outer(scale, scale) + _ALIKE * np.eye(len(scale))
        solved = np.linalg.solve(normal, right / scale) / scale
        return [{label: solved[at] for label, at in own.items()} for own in rows]

    def squares(
        self, blocks: Sequence[Block], strengths: Sequence[Strengths], scans: np.ndarray
    ) -> np.ndarray:
        """Return the mean squared residual of each scan with the given indices, after the columns of the
        blocks have been subtracted. Before the subtraction, each column is multiplied by its strength in the
        group to which the scan belongs. The result has shape (scans,).

        If a block has no strengths for the label of a scan, the block is not subtracted from this scan.
        """
        left = np.empty(len(scans))
        for at, scan in enumerate(scans):
            rest = np.eye(1, self.grams.shape[1])[0]
            for block, known in zip(blocks, strengths, strict=True):
                rest[list(block.columns)] -= known.get(self.groups[block.by][scan], 0.0)
            left[at] = rest @ self.grams[scan] @ rest
        return left

    def held_out(self, blocks: Sequence[Block], fold_of: np.ndarray) -> np.ndarray:
        """Return the cross-validated mean squared residual of each scan. For each scan, the strengths are
        fitted to the scans in the other folds. The result has shape (scans,).

        Args:
            fold_of: number of the fold of each scan, of shape (scans,).
        """
        left = np.empty(len(fold_of))
        for fold in np.unique(fold_of):
            own = np.flatnonzero(fold_of == fold)
            fitted = self.strengths(blocks, np.flatnonzero(fold_of != fold))
            left[own] = self.squares(blocks, fitted, own)
        return left
