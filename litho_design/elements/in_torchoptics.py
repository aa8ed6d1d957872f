"""A printed element for torchoptics; this module is imported only if torchoptics is installed."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torchoptics.elements import PolychromaticModulationElement
from torchoptics.utils import wavelength_or_default


class PrintedElement(PolychromaticModulationElement):
    """An ``Element`` that can be placed on a plane in torchoptics. The fields that it modulates must have the
    same shape and spacing as the element.

    Args:
        element: the printed element. Its parameters become the parameters of this module.
        z, offset: position of the element along and across the axis, as in torchoptics.
        unit_um: size, in µm, of the unit of length that your program uses in torchoptics.
    """

    def __init__(self, element: Any, *, z: float = 0.0, offset: Any = None, unit_um: float = 1.0):
        size, pitch = element.layout.size_px, element.layout.pitch_um
        # torchoptics accepts a field only if its spacing equals that of the element to the last bit, but 0.1
        # / 1e6 is not exactly 1e-7. The spacing is therefore rounded to 12 digits.
        super().__init__((size, size), z, float(f"{pitch / unit_um:.12g}"), offset)
        self.element, self.unit_um = element, unit_um

    def modulation_profile(self, wavelength: Any = None) -> Tensor:
        """Return the complex transmission of the element at a wavelength, shape (size, size). The wavelength
        is given in the unit of length that your program uses in torchoptics.
        """
        return self.element.transmission(float(wavelength_or_default(wavelength)) * self.unit_um)
