"""Make random layouts (by the equation of arXiv:2309.17343) and calibration patterns, and compute statistics
of layouts.
"""

from litho_data.layouts.layout_set import PATTERNS, write_layout_set
from litho_data.layouts.patterns import (
    checkerboard,
    flat,
    framed_ladder,
    isolated_features,
    line_space_sweep,
    relative_doses,
    siemens_star,
    step_ladder,
)
from litho_data.layouts.random_layout import random_layout
from litho_data.layouts.statistics import LayoutStatistics, layout_statistics

__all__ = [
    "PATTERNS",
    "LayoutStatistics",
    "checkerboard",
    "flat",
    "framed_ladder",
    "isolated_features",
    "layout_statistics",
    "line_space_sweep",
    "random_layout",
    "relative_doses",
    "siemens_star",
    "step_ladder",
    "write_layout_set",
]
