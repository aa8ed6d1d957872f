"""The formats of exports, apart from the code that writes them, so that the command line loads quickly."""

from typing import Literal

Format = Literal["png16", "bmp", "tiff", "stl", "gds", "dxf", "gwl"]
