"""Affine with a linear transfer function: the best a linear, isotropic blur can do."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor, nn

from litho_models.layers.gaussian import blur_interior, kernel_radius_px
from litho_models.simulator import Simulator, SimulatorConfig, crop_border


class AffineMtfConfig(SimulatorConfig):
    sigmas_um: tuple[float, ...] = Field((0.1, 0.2, 0.35, 0.6, 1.0, 1.8), min_length=1)


class AffineMtf(Simulator):
    """H = offset + Σ_j w_j (G_j * M): the transfer function is Σ_j w_j exp(-2π²σ_j²f²), its gain Σ_j w_j."""

    name = "affine-mtf"
    is_linear = True
    Config = AffineMtfConfig
    config: AffineMtfConfig

    def __init__(self, config: AffineMtfConfig):
        super().__init__(config)
        weights = torch.zeros(len(config.sigmas_um))
        weights[0] = 1.0
        self.weights = nn.Parameter(weights)
        self.offset_um = nn.Parameter(torch.tensor(0.0))

    @property
    def reach_px(self) -> int:
        return kernel_radius_px(max(self.config.sigmas_um) / self.pitch_um)

    def interior(self, layout_um: Tensor) -> Tensor:
        blurred = [
            blurred_interior(layout_um, sigma, self.pitch_um, self.reach_px)
            for sigma in self.config.sigmas_um
        ]
        return self.offset_um + (self.weights * torch.stack(blurred, dim=-1)).sum(dim=-1)


def blurred_interior(layout_um: Tensor, sigma_um: float, pitch_um: float, reach_px: int) -> Tensor:
    """One blur, cut to the pixels farther than ``reach_px`` from the edge."""
    radius = kernel_radius_px(sigma_um / pitch_um)
    inner = crop_border(layout_um, reach_px - radius)
    return blur_interior(inner, torch.tensor(sigma_um / pitch_um, device=layout_um.device), radius)
