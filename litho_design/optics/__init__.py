"""Scalar diffraction: pure, differentiable, tested against closed forms."""

from litho_design.optics.angular_spectrum import ASMPropagator
from litho_design.optics.blaze import blaze_efficiency, stroke_table
from litho_design.optics.radial import RadialPropagator
from litho_design.optics.rayleigh_sommerfeld import RSPropagator
from litho_design.optics.sampling import centred_grid, check_distance, sampling_limit_um
from litho_design.optics.thin_element import Optics, element_field, intensity_share

__all__ = [
    "ASMPropagator",
    "Optics",
    "RSPropagator",
    "RadialPropagator",
    "blaze_efficiency",
    "centred_grid",
    "check_distance",
    "element_field",
    "intensity_share",
    "sampling_limit_um",
    "stroke_table",
]
