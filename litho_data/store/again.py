"""Make references to scans of a store. Only such a reference, and not the arrays of the scans, is sent to
other processes. These processes read the scans from the store.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from litho_data.foundation import InputError
from litho_data.store.read import PrintedScan, Store, open_store


@dataclass(frozen=True)
class StoredScans:
    """A reference to some scans of a store: the path of the store, the hash of the dataset, and the ids of
    the scans.
    """

    path: str
    sha256: str
    ids: tuple[str, ...]

    @classmethod
    def of(cls, store: Store, scans: Sequence[PrintedScan]) -> StoredScans:
        """Make a reference to some scans of a store."""
        return cls(str(store.path), store.sha256, tuple(scan.id for scan in scans))

    def read(self) -> list[PrintedScan]:
        """Read the scans from the store.

        Raises:
            InputError: there is no store at the path, or the store contains another dataset.
        """
        store = open_store(self.path)
        if store.sha256 != self.sha256:
            raise InputError(
                f"store {self.path}",
                got=f"dataset {store.sha256[:12]}…",
                wanted=f"dataset {self.sha256[:12]}…, as at the start of the run",
            )
        return [store.scan(scan_id) for scan_id in self.ids]

    def by_id(self) -> dict[str, PrintedScan]:
        """Read the scans from the store, and return them in a dict keyed by id."""
        return {scan.id: scan for scan in self.read()}
