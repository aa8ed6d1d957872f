"""Affine: one gain and one offset."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from litho_models.simulator import Simulator, SimulatorConfig


class Affine(Simulator):
    """H = gain · M + offset."""

    name = "affine"
    is_linear = True

    def __init__(self, config: SimulatorConfig):
        super().__init__(config)
        self.gain = nn.Parameter(torch.tensor(1.0))
        self.offset_um = nn.Parameter(torch.tensor(0.0))

    @property
    def reach_px(self) -> int:
        return 0

    def interior(self, layout_um: Tensor) -> Tensor:
        return self.gain * layout_um + self.offset_um
