"""Affine with a linear transfer function: the best a linear, isotropic blur can do."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor, nn

from litho_models.layers.gaussian import blur_interior, kernel_radius_px
from litho_models.simulator import Simulator, SimulatorConfig


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


def blurred_interior(
    layout_um: Tensor, sigma_um: float | tuple[float, float], pitch_um: float, reach_px: int
) -> Tensor:
    """One blur (a pair: along y, along x), cut to the pixels farther than ``reach_px`` from the edge."""
    pair = sigma_um if isinstance(sigma_um, tuple) else (sigma_um, sigma_um)
    radii = kernel_radius_px(pair[0] / pitch_um), kernel_radius_px(pair[1] / pitch_um)
    rows, columns = (
        slice(reach_px - radius, length - reach_px + radius)
        for radius, length in zip(radii, layout_um.shape[-2:], strict=True)
    )
    y, x = (torch.tensor(sigma / pitch_um, device=layout_um.device) for sigma in pair)
    return blur_interior(layout_um[..., rows, columns], (y, x), radii)
