"""Scalar diffraction as differentiable functions without side effects, tested against closed-form
solutions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from litho_data.foundation.faces import lazy_face

if TYPE_CHECKING:
    from litho_design.optics.angular_spectrum import ASMPropagator as ASMPropagator
    from litho_design.optics.propagators import make_propagator as make_propagator
    from litho_design.optics.radial import RadialPropagator as RadialPropagator
    from litho_design.optics.rayleigh_sommerfeld import RSPropagator as RSPropagator
    from litho_design.optics.sampling import centred_grid as centred_grid
    from litho_design.optics.sampling import check_distance as check_distance
    from litho_design.optics.sampling import sampling_limit_um as sampling_limit_um
    from litho_design.optics.stroke import blaze_efficiency as blaze_efficiency
    from litho_design.optics.thin_element import Optics as Optics
    from litho_design.optics.thin_element import element_field as element_field
    from litho_design.optics.thin_element import intensity_share as intensity_share
else:
    # The names of this package are imported only when they are used, because the command line reads the
    # settings in `Optics` and must not import torch for this.
    __all__, __getattr__, __dir__ = lazy_face(__name__, __file__)
