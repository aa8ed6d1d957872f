"""Keep the finished scans of a store under construction, so that an interrupted build can resume.

A store is built in a folder ``.<name>.partial`` beside its path, and moved to this path when it is complete.
The record of a scan is written after its arrays, so a scan is finished if its record exists. A resumed build
reuses a finished scan only under two conditions: the scan's files, parameters and code have not changed, and
its arrays still have the recorded hashes.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np

from litho_data.foundation import Array, Facts, InputError, atomic_file, damaged
from litho_data.foundation.files import publish, unfinished
from litho_data.store.access import group_of, open_root, values_of
from litho_data.store.schema import LAYOUT_VARIABLES, SCAN_VARIABLES, STORE_SCHEMA, VARIABLES
from litho_data.store.write import write_scan_group

if TYPE_CHECKING:
    import zarr


@dataclass(frozen=True)
class Piece:
    """One finished scan: its arrays, keyed by name, and its record, which is plain data with the keys ``id``,
    ``key``, ``steps`` and others.
    """

    record: Facts
    arrays: Mapping[str, Array]


def outputs_of(record: Facts) -> list[Facts]:
    """From the record of a scan, return the descriptions (name, hash, shape, etc.) of all arrays that its
    steps made.
    """
    return [output for step in record["steps"] for output in step["outputs"]]


@contextmanager
def partial_store(out: Path) -> Iterator[PartialStore]:
    """Yield the unfinished store that will become ``out``, and lock it so that no other build uses it at the
    same time.

    Raises:
        InputError: ``out`` exists but is not a dataset store, cannot be written, or is already being built.
    """
    _require_replaceable(out)
    with unfinished(out) as folder:
        yield PartialStore(out, folder)


class PartialStore:
    """A store under construction. Its methods list the finished scans on disk, add scans, and publish the
    store.
    """

    def __init__(self, out: Path, folder: Path):
        self.out = out
        self.folder = folder
        self.store = self.folder / "store"
        self._pieces = self.folder / "pieces"

    def open(self) -> zarr.Group:
        """Remove everything except scans from the unfinished store, and return its root group, to which scans
        are added.
        """
        import zarr

        self._pieces.mkdir(exist_ok=True)
        if self.store.exists():
            others = [one for one in self.store.iterdir() if one.name != "scans"]
            # Zarr leaves temporary files if it is interrupted while it writes.
            others += [one for one in (self.store / "scans").glob("*") if one.is_file()]
            for child in others:
                shutil.rmtree(child) if child.is_dir() else child.unlink()
        root = zarr.open_group(self.store, mode="a", zarr_format=3)
        # The group must exist before several processes add scans to it at the same time.
        root.require_group("scans")
        return root

    def finished(self, root: zarr.Group, keys: Facts) -> dict[str, dict[str, Any]]:
        """Keep the finished scans that can be reused, and remove all others. Return the records of the scans
        that are kept, keyed by id.

        Args:
            root: the root group to which scans are added.
            keys: for each scan of the build, a function that returns the scan's key, i.e. a hash of
                everything that determines the scan. The functions are keyed by id.
        """
        records = {}
        for path in sorted(self._pieces.glob("*.json")):
            with suppress(InputError), damaged(str(path)):
                record = json.loads(path.read_text(encoding="utf-8"))
                scan_id = record["id"]
                if scan_id in keys and record["key"] == keys[scan_id]() and self._intact(root, record):
                    records[scan_id] = record
                    continue
            path.unlink()
        for path in (self.store / "scans").glob("*"):
            if path.is_dir() and path.name not in records:
                shutil.rmtree(path)
        return records

    def add(self, piece: Piece) -> None:
        """Write one finished scan to disk. The record is written last. Several processes may call this at the
        same time.
        """
        import zarr

        scan_id = piece.record["id"]
        root = zarr.open_group(self.store, mode="r+")
        pitch_um = piece.record.get("pitch_um", piece.record["read"]["pitch_um"])
        write_scan_group(root, scan_id, piece.arrays, piece.record["use"], pitch_um)
        samples = {v.name: piece.arrays[v.name] for v in LAYOUT_VARIABLES if v.name in piece.arrays}
        with atomic_file(self._pieces / f"{scan_id}.npz") as temporary, open(temporary, "wb") as stream:
            np.savez(stream, allow_pickle=False, **samples)
        with atomic_file(self._pieces / f"{scan_id}.json") as temporary:
            temporary.write_text(json.dumps(piece.record), encoding="utf-8")

    def samples(self, scan_id: str) -> dict[str, Array]:
        """Return the arrays of one finished scan that lie on the layout grid, keyed by name."""
        with np.load(self._pieces / f"{scan_id}.npz", allow_pickle=False) as archive:
            return dict(archive)

    def publish(self) -> None:
        """Move the finished store to its path, where it replaces an older store."""
        publish(self.store, self.out)
        self.discard()

    def discard(self) -> None:
        """Remove the unfinished store."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _intact(self, root: zarr.Group, record: Facts) -> bool:
        hashes = {output["name"]: output["sha256"] for output in outputs_of(record)}
        try:
            arrays = self.samples(record["id"])
            group = group_of(root, f"scans/{record['id']}")
            arrays |= {v.name: values_of(group, v.name) for v in SCAN_VARIABLES if v.name in hashes}
        except (OSError, ValueError, BadZipFile):  # InputError is a ValueError
            return False
        return {name: VARIABLES[name].sample_sha256(array) for name, array in arrays.items()} == hashes


def _require_replaceable(out: Path) -> None:
    if not out.exists():
        return
    if out.is_dir() and not any(out.iterdir()):
        return
    try:
        schema = open_root(out).attrs.get("schema")
    except InputError:
        schema = None
    if schema != STORE_SCHEMA or not out.is_dir():
        raise InputError(
            "output path",
            got=f"{out}, which exists but is not a dataset store",
            wanted="a new path, or a dataset store to replace",
        )
