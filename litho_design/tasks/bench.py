"""Propagate light through a printed element onto a window in the image plane, for one or for several sets of
optics. The window has the size of the element.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from litho_design.optics import Optics, centred_grid, element_field, intensity_share, make_propagator
from litho_design.optics.source import coherent_parts
from litho_design.optics.thin_element import flat_field
from litho_design.printers.layout import LayoutSettings


class ElementBench(nn.Module):
    """Propagate the light of a source through a printed element onto a window in the image plane. The window
    has the size of the element.

    ``propagator`` is the propagator for the middle wavelength of the source.
    """

    def __init__(self, layout: LayoutSettings, optics: Optics, *, dtype: torch.dtype = torch.complex64):
        super().__init__()
        self.optics = optics
        self.grid = self.window = centred_grid((layout.size_px, layout.size_px), layout.pitch_um)
        self.parts = coherent_parts(optics, layout.size_um)
        colours = {optics.wavelength_um: optics} | {part.wavelength_um: part for _, part in self.parts}
        # One propagator per wavelength is enough, because neither the direction of the light nor the resin
        # changes the propagation behind the element.
        self.carried = nn.ModuleDict(
            {_key(um): make_propagator(self.grid, self.grid, one, dtype=dtype) for um, one in colours.items()}
        )

    @property
    def propagator(self) -> Any:
        """Return the propagator from the element to the image plane, for the middle wavelength."""
        return self.carried[_key(self.optics.wavelength_um)]

    def illumination(self) -> Tensor:
        """Return the wave behind a flat element, complex128 of shape (size, size). The light has the middle
        wavelength and the middle direction of the source.
        """
        return flat_field(self.grid, self.optics)

    def waves(self, height_um: Tensor) -> Iterator[tuple[float, Tensor]]:
        """Yield one pair for each plane wave of the source: the share of the light in this wave, and the
        field that it produces in the image plane, shape (..., size, size).
        """
        for share, part in self.parts:
            wave = element_field(height_um, self.grid, part)
            yield share, self.carried[_key(part.wavelength_um)](wave)

    def forward(self, height_um: Tensor) -> Tensor:
        """Return the share of the incident power on each pixel of the window, shape (..., size, size), from
        printed heights in µm of the same shape.
        """
        found = [share * intensity_share(wave, self.grid) for share, wave in self.waves(height_um)]
        return sum(found[1:], found[0])


def _key(wavelength_um: float) -> str:
    # Names of modules must not contain a dot.
    return wavelength_um.hex().replace(".", "_")


class ViewsBench(nn.Module):
    """Compute the images behind one element for several wavelengths, image planes or angles of incidence."""

    def __init__(self, layout: LayoutSettings, views: Sequence[Optics]):
        super().__init__()
        self.benches = nn.ModuleList(ElementBench(layout, optics) for optics in views)
        self.grid = self.window = centred_grid((layout.size_px, layout.size_px), layout.pitch_um)

    def forward(self, height_um: Tensor) -> Tensor:
        """Return the share of the incident power on each pixel of each image, shape (views, size, size), for
        a height map in µm of shape (size, size).
        """
        return torch.stack([bench(height_um) for bench in self.benches])
