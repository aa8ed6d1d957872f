"""The tip of the microscope, from what it measured: radius, flanks, and where it did not touch."""

from litho_data.tip.blind import blind_tip, full_angle_bound_deg
from litho_data.tip.certainty import reconstructed, tip_certain
from litho_data.tip.estimate import TipEstimate, estimate_tip
from litho_data.tip.morphology import dilate, erode, paraboloid_dilation, paraboloid_erosion
from litho_data.tip.resolution import lateral_resolution_um

__all__ = [
    "TipEstimate",
    "blind_tip",
    "dilate",
    "erode",
    "estimate_tip",
    "full_angle_bound_deg",
    "lateral_resolution_um",
    "paraboloid_dilation",
    "paraboloid_erosion",
    "reconstructed",
    "tip_certain",
]
