"""Instrument files in, ``Scan`` objects out; one module per format."""

from __future__ import annotations

from litho_data.readers.layout import read_layout
from litho_data.readers.read import FORMATS, list_channels, read_scan

__all__ = ["FORMATS", "list_channels", "read_layout", "read_scan"]
