"""The dataset store: schema, reading and writing."""

from litho_data.store.read import PrintedScan, Store, open_store

__all__ = ["PrintedScan", "Store", "open_store"]
