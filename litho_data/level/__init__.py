"""Level scans, i.e. remove tilt, bow and row offsets from their heights. Every levelling operation returns
the levelled height map and the surface that it subtracted.
"""

from litho_data.level.features import mark_features, mask_and_relevel
from litho_data.level.layout_aware import layout_in_scan_frame, level_layout_aware
from litho_data.level.plane import (
    fix_zero,
    level_facet,
    level_plane,
    zero_max,
    zero_mean,
)
from litho_data.level.polynomial import level_polynomial, level_robust
from litho_data.level.recipe import Recipe
from litho_data.level.rows import LevellingWarning, align_rows
from litho_data.level.scars import mark_scars, remove_scars
from litho_data.level.selection import Levelled, MaskedLevelling, Masking

__all__ = [
    "Levelled",
    "LevellingWarning",
    "MaskedLevelling",
    "Masking",
    "Recipe",
    "align_rows",
    "fix_zero",
    "layout_in_scan_frame",
    "level_facet",
    "level_layout_aware",
    "level_plane",
    "level_polynomial",
    "level_robust",
    "mark_features",
    "mark_scars",
    "mask_and_relevel",
    "remove_scars",
    "zero_max",
    "zero_mean",
]
