"""Choose the lock box of a dataset. The lock box contains scans that are set aside for the final test. They
must not influence any choice of a model or an effect.

The scans are selected by hashes of the ids and prints, and not by the random generator of a library. The same
dataset therefore always has the same lock box.
"""

import hashlib
from collections.abc import Sequence
from typing import Protocol

from litho_data.foundation import Array, InputError, record_sha256
from litho_data.store.schema import VARIABLES

FIELD_COLUMNS = ("field_x_um", "field_y_um", "dose")
"""Columns that tell apart fields of one print that have the same layout."""


class HasField(Protocol):
    """Protocol for objects that state the id of a scan and describe the printed field that the scan shows.
    The id and the field determine whether the scan is put into the lock box.
    """

    @property
    def id(self) -> str: ...
    @property
    def print_id(self) -> str: ...
    @property
    def mask_level(self) -> Array: ...
    @property
    def field_x_um(self) -> float | None: ...
    @property
    def field_y_um(self) -> float | None: ...
    @property
    def dose(self) -> float | None: ...


def locked_ids(scans: Sequence[HasField]) -> list[str]:
    """Return the ids of the scans in the lock box of a dataset. ``scans`` are all scans of the dataset."""
    ids, print_ids = [scan.id for scan in scans], [scan.print_id for scan in scans]
    return lock_box(ids, print_ids, [field_of(scan) for scan in scans])


def field_of(scan: HasField) -> str:
    """Return the hash that identifies the printed field of a scan (see ``field_sha256``)."""
    stated = [getattr(scan, name) for name in FIELD_COLUMNS]
    return field_sha256(scan.print_id, scan.mask_level, stated)


def field_sha256(print_id: str, mask_level: Array, stated: Sequence[float | None]) -> str:
    """Return the hash that identifies a printed field. Scans of one field, such as trace and retrace, have
    the same print, layout, position and dose.

    Args:
        print_id: the print of the field.
        mask_level: levels of the layout, shape (ny, nx).
        stated: values of the columns ``FIELD_COLUMNS``.
    """
    return record_sha256([print_id, VARIABLES["mask_level"].sample_sha256(mask_level), *stated])


def lock_box(ids: Sequence[str], print_ids: Sequence[str], fields: Sequence[str]) -> list[str]:
    """Return the ids of the scans in the lock box. A sixth of the printed fields, but at least one field, is
    drawn, from different prints if possible. The lock box contains all scans of the drawn fields.

    If the dataset has only one or two fields, the lock box is empty.

    Args:
        ids: ids of the scans.
        print_ids: the print of each scan, in the same order.
        fields: the printed field of each scan, as ``field_of`` returns it.

    Raises:
        InputError: an id occurs twice, or the lists have different lengths.
    """
    require_unique(ids)
    if len(print_ids) != len(ids):
        raise InputError("print_ids", got=f"{len(print_ids)} entries", wanted=f"{len(ids)}, one per scan id")
    print_of = dict(zip(ids, print_ids, strict=True))
    by_print: dict[str, list[list[str]]] = {}
    every = scans_by_field(ids, fields, 0)
    for members in every:
        by_print.setdefault(print_of[members[0]], []).append(members)
    prints = sorted(by_print, key=lambda print_id: drawing_key(f"print {print_id}", 0))
    turns = range(len(every))
    drawn = [by_print[name][turn] for turn in turns for name in prints if turn < len(by_print[name])]
    count = max(1, round(len(every) / 6)) if len(every) > 2 else 0
    return sorted(scan_id for members in drawn[:count] for scan_id in members)


def scans_by_field(ids: Sequence[str], fields: Sequence[str], seed: int) -> list[list[str]]:
    """Return one list per printed field, with the ids of its scans. The fields are in a random order.

    Scans of one field share the errors of the print, so they must not be divided between training and test.
    """
    found: dict[str, list[str]] = {}
    for scan_id, of in sorted(zip(ids, fields, strict=True), key=lambda one: drawing_key(one[0], seed)):
        found.setdefault(of, []).append(scan_id)
    return list(found.values())


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
    """Return the hex SHA-256 of a set of ids. The hashed text contains the sorted ids, one per line."""
    return hashlib.sha256("\n".join(sorted(ids)).encode()).hexdigest()
