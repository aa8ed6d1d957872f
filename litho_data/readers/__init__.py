"""Read files of instruments as ``Scan`` objects. Each module reads one format or several related formats."""

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
