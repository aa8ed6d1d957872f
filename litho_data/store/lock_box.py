"""The lock box: scans of a dataset that no choice of a model or an effect may use.

The choice follows from a hash of the ids, not from a library's random generator, so the same ids always give
the same lock box.
"""

import hashlib
from collections.abc import Sequence
from typing import Protocol

from litho_data.foundation import InputError


class HasPrint(Protocol):
    """The facts about a scan for the draw: its id and its print."""

    @property
    def id(self) -> str: ...
    @property
    def print_id(self) -> str: ...


def locked_ids(scans: Sequence[HasPrint]) -> list[str]:
    """The lock box of a dataset; takes all of its scans."""
    return lock_box([scan.id for scan in scans], [scan.print_id for scan in scans])


def lock_box(ids: Sequence[str], print_ids: Sequence[str]) -> list[str]:
    """A sixth of the scans, at least one, from different prints if possible; empty for one or two scans.

    Args:
        ids: scan ids; ``print_ids``: the print of each, same length.

    Raises:
        InputError: ids that repeat, or lists of different length.
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
    """A key to sort names by; the order is the same on every machine and differs between seeds."""
    return hashlib.sha256(f"{seed}:{name}".encode()).hexdigest()


def require_unique(ids: Sequence[str]) -> None:
    """Refuse ids that repeat.

    Raises:
        InputError: names the ids that repeat.
    """
    if len(set(ids)) != len(ids):
        repeated = sorted({scan_id for scan_id in ids if list(ids).count(scan_id) > 1})
        raise InputError("scan ids repeat", got=", ".join(repeated), wanted="unique ids")


def ids_sha256(ids: Sequence[str]) -> str:
    """Hex SHA-256 of a set of ids: sorted, one per line."""
    return hashlib.sha256("\n".join(sorted(ids)).encode()).hexdigest()
