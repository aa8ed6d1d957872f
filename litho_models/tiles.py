"""Whole fields of any size: predicted in tiles with their surroundings where the model allows it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from litho_data.store import PrintedScan
from litho_models.gaussian import pad_field
from litho_models.simulator import Simulator

TILE_PX = 1024


def predict_field(model: Simulator, layout_um: Tensor, tile_px: int = TILE_PX) -> Tensor:
    """Height (b, 1, y, x) of a layout (b, 1, y, x), µm; gradients flow to the layout.

    A field larger than ``tile_px`` is computed tile by tile, each with the receptive radius around
    it, which gives the same heights as the whole field at once.
    """
    reach = model.reach_px
    ny, nx = layout_um.shape[-2:]
    if reach is None or max(ny, nx) <= tile_px:
        return model(layout_um)
    whole = pad_field(layout_um, reach, reach)
    rows = []
    for y in range(0, ny, tile_px):
        stop = min(y + tile_px, ny)
        tiles = [
            model.interior(whole[..., y : stop + 2 * reach, x : min(x + tile_px, nx) + 2 * reach])
            for x in range(0, nx, tile_px)
        ]
        rows.append(torch.cat(tiles, dim=-1))
    return torch.cat(rows, dim=-2)


def predict_scan(model: Simulator, scan: PrintedScan) -> np.ndarray:
    """Height that the model expects for one scan, float32 (ny, nx) µm; no gradients."""
    device = next(model.parameters(), torch.empty(0)).device
    with torch.no_grad():
        layout = torch.from_numpy(scan.layout_um)[None, None].to(device)
        return predict_field(model, layout)[0, 0].float().cpu().numpy()
