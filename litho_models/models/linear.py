"""Linear in features: blurs, their powers and slopes. Few parameters, closed form, a strong reference."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor, nn

from litho_models.layers.gaussian import kernel_radius_px
from litho_models.models.affine_mtf import blurred_interior
from litho_models.simulator import Simulator, SimulatorConfig, crop_border


class LinearConfig(SimulatorConfig):
    sigmas_um: tuple[float, ...] = Field((0.1, 0.2, 0.35, 0.6, 1.0, 1.8, 3.0), min_length=1)
    power_sigma_um: float = 0.25
    power_reference_um: float = 0.5


class Linear(Simulator):
    """H = w · φ(M): Gaussian blurs, second to fourth power of one blur, its squared slopes, and 1.

    The slopes along y and x have their own weights: the two axes of a print need not behave alike.
    """

    name = "linear"
    is_linear = True
    Config = LinearConfig
    config: LinearConfig

    def __init__(self, config: LinearConfig):
        super().__init__(config)
        weights = torch.zeros(len(config.sigmas_um) + 6)
        weights[0] = 1.0
        self.weights = nn.Parameter(weights)

    @property
    def reach_px(self) -> int:
        return kernel_radius_px(max(self.config.sigmas_um) / self.pitch_um) + 1

    def interior(self, layout_um: Tensor) -> Tensor:
        return (self.weights * self.features(layout_um)).sum(dim=-1)

    def features(self, layout_um: Tensor) -> Tensor:
        """φ(M) of the interior, (b, 1, y, x, features)."""
        config, reach = self.config, self.reach_px
        blurs = [blurred_interior(layout_um, sigma, self.pitch_um, reach) for sigma in config.sigmas_um]
        wide = blurred_interior(layout_um, config.power_sigma_um, self.pitch_um, reach - 1)
        slope_y = (wide[..., 2:, 1:-1] - wide[..., :-2, 1:-1]) / (2 * self.pitch_um)
        slope_x = (wide[..., 1:-1, 2:] - wide[..., 1:-1, :-2]) / (2 * self.pitch_um)
        centred = crop_border(wide, 1) - config.power_reference_um
        powers = [centred**2, centred**3, centred**4]
        return torch.stack([*blurs, *powers, slope_y**2, slope_x**2, torch.ones_like(centred)], dim=-1)
