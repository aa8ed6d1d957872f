"""Estimate the radius of an AFM tip from scans made with it, and find where the tip did not touch the
surface.
"""

from litho_data.tip.certainty import reconstructed, tip_certain
from litho_data.tip.estimate import TipEstimate, estimate_tip
from litho_data.tip.morphology import paraboloid_erosion
from litho_data.tip.resolution import lateral_resolution_um

__all__ = [
    "TipEstimate",
    "estimate_tip",
    "lateral_resolution_um",
    "paraboloid_erosion",
    "reconstructed",
    "tip_certain",
]
