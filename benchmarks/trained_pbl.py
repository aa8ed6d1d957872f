"""The trained PBL whose speed is measured: its weights, a layout for it, the work in its layers."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import torch

from litho_data.foundation.errors import InputError
from litho_models.frozen.card import ModelCard
from litho_models.frozen.files import load_simulator
from litho_models.models.pbl import Pbl, PblConfig


def load_pbl(folder: Path) -> Pbl:
    """The trained PBL in a folder, its chain alone, with weights that learn.

    Raises:
        InputError: a chain that the plain version does not have.
    """
    model = load_simulator(folder, ModelCard.read(folder))
    assert isinstance(model, Pbl)
    if model.mismatch.transposable:
        raise InputError(
            "areawise network", got="one that does not know x from y", wanted="the published one"
        )
    return model.chain()


def random_layout(config: PblConfig, size_px: int, batch: int = 1) -> torch.Tensor:
    """Random levels on squares of 4 px, heights in µm (batch, 1, size, size)."""
    generator = torch.Generator().manual_seed(0)
    cells = -(-size_px // 4)
    level = torch.randint(0, config.levels, (batch, 1, cells, cells), generator=generator).float()
    level = level.repeat_interleave(4, -1).repeat_interleave(4, -2)[..., :size_px, :size_px]
    return (level * config.level_height_um).contiguous()


def areawise_gflop(config: PblConfig, pixels: int) -> float:
    """Multiplications and additions of the 3 x 3 layers on so many pixels, one way, GFLOP."""
    widths = (1, *config.areawise_channels, 1)
    return 2 * 9 * sum(a * b for a, b in pairwise(widths)) * pixels / 1e9
