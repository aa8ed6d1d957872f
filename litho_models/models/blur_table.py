"""Blur, then a level table: a learned spot size and a free height for every level."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor, nn

from litho_models.layers.gaussian import blur_interior, kernel_radius_px
from litho_models.layers.lookup import interpolate
from litho_models.layers.ranges import Range
from litho_models.simulator import Simulator, SimulatorConfig


class BlurTableConfig(SimulatorConfig):
    sigma_max_um: float = Field(1.0, gt=0, description="upper bound of the blur, µm")
    sigma_init_um: float = Field(0.25, gt=0, description="blur before fitting, µm")


class BlurTable(Simulator):
    """H = T(G_σ * M), T linear between one free height per level."""

    name = "blur-table"
    Config = BlurTableConfig
    config: BlurTableConfig

    def __init__(self, config: BlurTableConfig):
        super().__init__(config)
        self.tau = nn.Parameter(self.ranges["tau"].raw(config.sigma_init_um))
        self.table_um = nn.Parameter(torch.arange(config.levels) * config.level_height_um)

    @property
    def ranges(self) -> dict[str, Range]:
        return {"tau": Range("sigma_um", 0.0, self.config.sigma_max_um)}

    @property
    def sigma_um(self) -> Tensor:
        """Blur, between 0 and ``sigma_max_um``."""
        return self.ranges["tau"].value(self.tau)

    @property
    def reach_px(self) -> int:
        return kernel_radius_px(float(self.sigma_um.detach()) / self.pitch_um)

    def interior(self, layout_um: Tensor) -> Tensor:
        dose = blur_interior(layout_um, self.sigma_um / self.pitch_um, self.reach_px)
        return interpolate(dose, self.table_um, 0.0, self.config.full_height_um)
