"""Choose the propagator that the settings request or, for ``auto``, a propagator that is valid at the given
distance.
"""

from __future__ import annotations

import torch

from litho_data.foundation.grid import PixelGrid
from litho_design.optics.angular_spectrum import ASMPropagator
from litho_design.optics.far_field import FarFieldPropagator
from litho_design.optics.rayleigh_sommerfeld import RSPropagator
from litho_design.optics.sampling import sampling_limit_um
from litho_design.optics.thin_element import Optics

Propagator = RSPropagator | ASMPropagator | FarFieldPropagator


def make_propagator(
    source: PixelGrid, target: PixelGrid, optics: Optics, *, dtype: torch.dtype = torch.complex64
) -> Propagator:
    """Make the propagator that carries waves from the grid ``source`` to the grid ``target``, as ``optics``
    specifies.

    The propagation ``auto`` uses the Rayleigh-Sommerfeld sum if its sampled kernel is not aliased. At shorter
    distances, ``auto`` uses the angular spectrum. ``far-field`` uses the distance as the focal length of an
    ideal lens.

    Raises:
        InputError: ``rayleigh-sommerfeld`` is requested at a distance below the sampling limit, or the
            angular spectrum is used between grids of unequal pitch.
    """
    kind: type[Propagator] = ASMPropagator if takes_spectrum(source, target, optics) else RSPropagator
    if optics.propagation == "far-field":
        kind = FarFieldPropagator
    return kind(source, target, optics.distance_um, optics.wavelength_um, dtype=dtype)


def takes_spectrum(source: PixelGrid, target: PixelGrid, optics: Optics) -> bool:
    """Return True if the settings request the angular spectrum, or if they request ``auto`` and the
    Rayleigh-Sommerfeld kernel would be aliased.
    """
    near = optics.distance_um < sampling_limit_um(source, target, optics.wavelength_um)
    return optics.propagation == "angular-spectrum" or (optics.propagation == "auto" and near)
