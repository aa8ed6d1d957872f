"""References to scans of a store, which other processes read instead of receiving the arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from litho_data.foundation import InputError
from litho_data.store.read import PrintedScan, Store, open_store


@dataclass(frozen=True)
class StoredScans:
    """Some scans of a store: path of the store, hash of the dataset, ids of the scans."""

    path: str
    sha256: str
    ids: tuple[str, ...]

    @classmethod
    def of(cls, store: Store, scans: Sequence[PrintedScan]) -> StoredScans:
        """The reference to these scans."""
        return cls(str(store.path), store.sha256, tuple(scan.id for scan in scans))

    def read(self) -> list[PrintedScan]:
        """The scans.

        Raises:
            InputError: no store at the path, or one of another dataset.
        """
        store = open_store(self.path)
        if store.sha256 != self.sha256:
            raise InputError(
                f"store {self.path}",
                got=f"dataset {store.sha256[:12]}…",
                wanted=f"{self.sha256[:12]}…, as at the start",
            )
        return [store.scan(scan_id) for scan_id in self.ids]

    def by_id(self) -> dict[str, PrintedScan]:
        """The scans by their ids."""
        return {scan.id: scan for scan in self.read()}
