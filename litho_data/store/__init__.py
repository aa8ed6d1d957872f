"""The dataset store: its schema, and functions to read and write it."""

from litho_data.store.read import PrintedScan, Store, open_store

__all__ = ["PrintedScan", "Store", "open_store"]
