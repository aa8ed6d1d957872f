"""The lock box: scans of a dataset that no choice of a model or an effect may use.

Every choice follows from a hash of the ids and a seed. It depends on no library's random generator, so the
same ids always give the same lock box.
"""

import hashlib
from collections.abc import Sequence
from typing import Protocol

from litho_data.foundation.errors import InputError


class HasPrint(Protocol):
    """What the draw needs of a scan: its id, and the print it is from."""

    @property
    def id(self) -> str: ...
    @property
    def print_id(self) -> str: ...


def locked_ids(scans: Sequence[HasPrint], seed: int = 0) -> list[str]:
    """The lock box of a dataset: a sixth of its scans, from different prints. Give it all the scans."""
    ids, prints = [scan.id for scan in scans], [scan.print_id for scan in scans]
    return lock_box(ids, prints, lock_box_size(len(ids)), seed)


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
    require_unique(ids)
    if len(print_ids) != len(ids):
        raise InputError("print_ids", got=f"{len(print_ids)} entries", wanted=f"{len(ids)}, one per scan id")
    if n and n >= len(ids):
        raise InputError("lock box", got=f"{n} of {len(ids)} scans", wanted="at least one scan left for work")
    by_print: dict[str, list[str]] = {}
    pairs = zip(ids, print_ids, strict=True)
    for scan_id, print_id in sorted(pairs, key=lambda pair: drawing_key(pair[0], seed)):
        by_print.setdefault(print_id, []).append(scan_id)
    prints = sorted(by_print, key=lambda print_id: drawing_key(f"print {print_id}", seed))
    chosen: list[str] = []
    for turn in range(len(ids)):
        chosen += [by_print[name][turn] for name in prints if turn < len(by_print[name])]
    return sorted(chosen[:n])


def drawing_key(name: str, seed: int) -> str:
    """A key to sort names by: the same names in the same order on every machine, another per seed."""
    return hashlib.sha256(f"{seed}:{name}".encode()).hexdigest()


def require_unique(ids: Sequence[str]) -> None:
    """Refuse ids that repeat.

    Raises:
        InputError: with the ids that do.
    """
    if len(set(ids)) != len(ids):
        repeated = sorted({scan_id for scan_id in ids if list(ids).count(scan_id) > 1})
        raise InputError("scan ids repeat", got=", ".join(repeated), wanted="unique ids")


def ids_sha256(ids: Sequence[str]) -> str:
    """Hex SHA-256 of a set of ids: sorted, one per line."""
    return hashlib.sha256("\n".join(sorted(ids)).encode()).hexdigest()
