"""The optics of a holographic element: from levels to an image, a loss and a score."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from litho_data.foundation.results import Record
from litho_design.judging.metrics import CameraView, HologramScore, hologram_score, matched_scale
from litho_design.optics import Optics, RSPropagator, centred_grid, element_field, intensity_share
from litho_design.optimisation.parametrise import LayoutSettings


class HologramLoss(Record):
    """RMSE(target, image) + efficiency_weight * (1 - efficiency).

    ``scale`` says how the image is brought to the scale of the target: ``paper`` divides by its
    mean over the wanted light, ``least-squares`` takes the factor of least error. The efficiency is
    the share of the incident power on pixels whose target is above zero.
    """

    scale: Literal["paper", "least-squares"] = "paper"
    efficiency_weight: float = 0.1


class HologramBench(nn.Module):
    """Light through a printed element onto the image plane (element and window of equal size)."""

    def __init__(self, layout: LayoutSettings, optics: Optics, *, dtype: torch.dtype = torch.complex64):
        super().__init__()
        self.optics = optics
        self.grid = centred_grid((layout.size_px, layout.size_px), layout.pitch_um)
        self.propagator = RSPropagator(
            self.grid, self.grid, optics.distance_um, optics.wavelength_um, dtype=dtype
        )

    def forward(self, height_um: Tensor) -> Tensor:
        """Share of the incident power on each pixel of the window, of heights (..., size, size) in µm."""
        return intensity_share(self.propagator(element_field(height_um, self.grid, self.optics)), self.grid)

    @torch.no_grad()
    def score(self, height_um: Tensor, target: Tensor, camera: CameraView) -> HologramScore:
        """Score printed heights (size, size), µm, against ``target`` (size, size)."""
        element = element_field(height_um, self.grid, self.optics)
        return hologram_score(self.propagator(element), element, target, self.grid, self.optics, camera)


def image_error(share: Tensor, target: Tensor, scale: str) -> tuple[Tensor, Tensor]:
    """RMSE after scaling, and the efficiency on {target > 0}."""
    lit = (share * target).sum()
    factor = target.sum() / lit if scale == "paper" else matched_scale(share, target)
    rmse = (factor * share - target).square().mean().sqrt()
    return rmse, share[target > 0].sum()
