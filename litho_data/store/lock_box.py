"""Choose the lock box of a dataset: scans that are set aside for the final test, so they must not influence
any choice of a model or an effect.

The choice depends on a hash of the ids instead of a library's random generator, so the same ids always give
the same lock box.
"""

import hashlib
from collections.abc import Sequence
from typing import Protocol

from litho_data.foundation import InputError


class HasPrint(Protocol):
    """Protocol for objects that state the id and the print of a scan, which determine whether the scan is put
    into the lock box.
    """

    @property
    def id(self) -> str: ...
    @property
    def print_id(self) -> str: ...


def locked_ids(scans: Sequence[HasPrint]) -> list[str]:
    """Return the ids of the scans in the lock box of a dataset. ``scans`` are all scans of the dataset."""
    return lock_box([scan.id for scan in scans], [scan.print_id for scan in scans])


def lock_box(ids: Sequence[str], print_ids: Sequence[str]) -> list[str]:
    """Return the ids of the scans in the lock box: a sixth of all scans, but at least one, from different
    prints if possible.

    If the dataset has only one or two scans, none is chosen.

    Args:
        ids: ids of the scans.
        print_ids: the print of each scan, in the same order.

    Raises:
        InputError: an id occurs twice, or the lists have different lengths.
    """
    require_unique(ids)
    if len(print_ids) != len(ids):
        raise InputError("print_ids", got=f"{len(print_ids)} entries", wanted=f"{len(ids)}, one per scan id")
    by_print: dict[str, list[str]] = {}
    for scan_id, print_id in sorted(
        zip(ids, print_ids, strict=True), key=lambda pair: drawing_key(pair[0], 0)
    ):
        by_print.setdefault(print_id, []).append(scan_id)
    prints = sorted(by_print, key=lambda print_id: drawing_key(f"print {print_id}", 0))
    turns = range(len(ids))
    drawn = [by_print[name][turn] for turn in turns for name in prints if turn < len(by_print[name])]
    return sorted(drawn[: max(1, round(len(ids) / 6)) if len(ids) > 2 else 0])


def drawing_key(name: str, seed: int) -> str:
    """Return a key by which names can be sorted into a random order. The order depends only on the names and
    the seed, so it is the same on every machine.
    """
    return hashlib.sha256(f"{seed}:{name}".encode()).hexdigest()


def require_unique(ids: Sequence[str]) -> None:
    """Refuse duplicate ids.

    Raises:
        InputError: an id occurs twice; the message names all such ids.
    """
    if len(set(ids)) != len(ids):
        repeated = sorted({scan_id for scan_id in ids if list(ids).count(scan_id) > 1})
        raise InputError("scan ids repeat", got=", ".join(repeated), wanted="unique ids")


def ids_sha256(ids: Sequence[str]) -> str:
    """Return the hex SHA-256 of a set of ids. The hash is that of the sorted ids, written one per line."""
    return hashlib.sha256("\n".join(sorted(ids)).encode()).hexdigest()
