"""Settings of a print job that the layout does not contain: the file format, the base under the element, and
the slices and lines in which the element is printed.
"""

from __future__ import annotations

from typing import Literal

from litho_data.commands.settings import setting
from litho_data.foundation.quantities import LEVEL_HEIGHT_UM
from litho_data.foundation.results import Record

Format = Literal["png16", "bmp", "tiff", "stl", "gds", "dxf", "gwl"]
GdsLayers = Literal["cumulative", "exclusive"]
_MOST = LEVEL_HEIGHT_UM.high


class Gwl(Record):
    """Settings with which a Nanoscribe printer prints the slices of a GWL file."""

    mode: Literal["galvo", "piezo"] = setting("galvo", "What moves the focus", option="--gwl-mode")
    field_um: float = setting(
        100.0, "Side of a write field of the galvo", unit="µm", option="--gwl-field-um", gt=0
    )
    speed_um_s: float = setting(40000.0, "Scan speed", unit="µm/s", option="--gwl-speed", gt=0, le=1e7)
    power_percent: tuple[float, ...] = setting(
        (50.0,),
        "Laser power, %: one number, or one for the pedestal and one for every level above it",
        option="--gwl-power",
    )


class PrintJob(Record):
    """Settings of a print job. Only STL and GWL files contain the base, but every sidecar records the base,
    the slicing and the hatching.
    """

    pedestal_um: float = setting(
        1.0, "Height of the base under level 0", unit="µm", option="--pedestal-um", ge=0, le=_MOST
    )
    slicing_um: float = setting(0.1, "Slicing distance", unit="µm", option="--slicing-um", gt=0, le=_MOST)
    hatching_um: float = setting(0.1, "Hatching distance", unit="µm", option="--hatching-um", gt=0, le=_MOST)
    gds_layers: GdsLayers = setting(
        "cumulative",
        "Pixels in layer k: those with level >= k (cumulative), or those with level == k (exclusive)",
        option="--gds-layers",
    )
    gwl: Gwl = setting(Gwl(), "GWL")
