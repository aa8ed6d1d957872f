"""Light through a printed element onto a window of its size, once for every set of optics."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from litho_design.optics import Optics, centred_grid, element_field, intensity_share, make_propagator
from litho_design.printers.layout import LayoutSettings


class ElementBench(nn.Module):
    """Light through a printed element onto the image plane (element and window of equal size)."""

    def __init__(self, layout: LayoutSettings, optics: Optics, *, dtype: torch.dtype = torch.complex64):
        super().__init__()
        self.optics = optics
        self.grid = self.window = centred_grid((layout.size_px, layout.size_px), layout.pitch_um)
        self.propagator = make_propagator(self.grid, self.grid, optics, dtype=dtype)

    def forward(self, height_um: Tensor) -> Tensor:
        """Share of the incident power on each pixel of the window, of heights (..., size, size) in µm."""
        return intensity_share(self.propagator(element_field(height_um, self.grid, self.optics)), self.grid)


class ViewsBench(nn.Module):
    """The images behind one element in several optics: colours, planes, angles of incidence."""

    def __init__(self, layout: LayoutSettings, views: Sequence[Optics]):
        super().__init__()
        self.benches = nn.ModuleList(ElementBench(layout, optics) for optics in views)
        self.grid = self.window = centred_grid((layout.size_px, layout.size_px), layout.pitch_um)

    def forward(self, height_um: Tensor) -> Tensor:
        """Shares of the incident power (views, size, size) of a height (size, size), µm."""
        return torch.stack([bench(height_um) for bench in self.benches])
