"""Which scans belong together: the groups by which something may differ from scan to scan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from litho_data.store import PrintedScan

Labels = tuple[str, ...]
ALL = "all"
# With fewer in a group, what it has in common cannot be told from what one scan has.
FEWEST_IN_GROUP = 2
_STATED = ("tip", "direction", "turned_deg")
_ORDER, _CHARACTER = "order", "character"


def label_of(scan: PrintedScan, by: str) -> str:
    """The label of a scan in a grouping, by the grouping's name; empty where the scan has none."""
    if by == ALL:
        return ""
    if by in scan.groups:
        return scan.groups[by]
    if by == "print":
        return scan.print_id
    if by in _STATED:
        stated = getattr(scan, by)
        return "" if stated is None else f"{stated:g}"
    # A group of the card may have any word for a name, but no blank in it.
    kind, _, value = by.partition(" ")
    if value and kind == _ORDER:
        last, first = map(int, value.split("-"))
        # Of a scan in between nobody knows whether the change had come.
        return "before" if scan.order <= last else "from there on" if scan.order >= first else ""
    if value and kind == _CHARACTER:
        return scan.id[int(value) - 1 : int(value)]
    return ""


def groupings(scans: Sequence[PrintedScan], *, by_order: bool = True) -> dict[str, Labels]:
    """Label of each scan by grouping; ``all`` is always there and comes first.

    Groups come from the card (print, field, tip, direction and turn of a scan), from the ids, where each
    character that varies may stand for a group, and, with ``by_order``, from the order: before and after
    every place at which something may have changed. A grouping counts if it has two labels or more, at
    least half of them of two scans or more; of two that divide the scans alike the first counts.
    """
    stated = list(dict.fromkeys(name for scan in scans for name in scan.groups))
    names = [ALL, *stated, "print", *_STATED]
    if len({len(scan.id) for scan in scans}) == 1:
        names += [f"{_CHARACTER} {at}" for at in range(1, len(scans[0].id) + 1)]
    found: dict[str, Labels] = {}
    for name in names:
        labels = tuple(label_of(scan, name) for scan in scans)
        if name == ALL or (_is_grouped(labels) and not _is_known(labels, found)):
            found[name] = labels
    if by_order:
        for first in _places(scans, found.get("print")):
            last = max(scan.order for scan in scans if scan.order < first)
            name = f"{_ORDER} {last}-{first}"
            labels = tuple(label_of(scan, name) for scan in scans)
            if not _is_known(labels, found):
                found[name] = labels
    return found


def _is_grouped(labels: Labels) -> bool:
    counts = Counter(labels).values()
    return len(counts) > 1 and 2 * sum(count >= FEWEST_IN_GROUP for count in counts) >= len(counts)


def _is_known(labels: Labels, found: Mapping[str, Labels]) -> bool:
    return any(
        len(set(zip(labels, own, strict=True))) == len(set(labels)) == len(set(own)) for own in found.values()
    )


def _places(scans: Sequence[PrintedScan], prints: Labels | None) -> list[int]:
    """Orders at which a change may have come: where a print begins, or anywhere with two scans a side."""
    orders = sorted({scan.order for scan in scans})
    if prints is not None:
        first = {
            label: min(s.order for s, own in zip(scans, prints, strict=True) if own == label)
            for label in prints
        }
        return [order for order in sorted(set(first.values())) if order > orders[0]]
    return orders[FEWEST_IN_GROUP : len(orders) - FEWEST_IN_GROUP + 1]
