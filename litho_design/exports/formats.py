"""The formats that a design is exported in; a command line reads them without loading what writes them."""

from typing import Literal

Format = Literal["png16", "bmp", "tiff", "stl", "gds", "dxf", "gwl"]
