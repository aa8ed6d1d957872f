"""Instrument files in, ``Scan`` objects out; one module per format."""

from litho_data.readers.layout import read_layout
from litho_data.readers.read import list_channels, read_scan
from litho_data.readers.reader import Channel, Reader
from litho_data.readers.registry import formats, register_reader

__all__ = [
    "Channel",
    "Reader",
    "formats",
    "list_channels",
    "read_layout",
    "read_scan",
    "register_reader",
]
