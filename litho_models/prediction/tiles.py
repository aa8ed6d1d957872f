"""Predict layouts of any size tile by tile. For a model with a receptive radius, the result does not depend
on the division into tiles. For other models, the result is blended from overlapping tiles.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan
from litho_models.layers.gaussian import pad_field
from litho_models.simulator import Simulator, Tile, crop_border

TILE_PX = 1024


def predict_field(model: Simulator, layout_um: Tensor, tile_px: int = TILE_PX) -> Tensor:
    """Predict the printed height of a layout. Layout and height have shape (batch, 1, ny, nx) and are in µm.
    The height is differentiable in the layout.

    A layout larger than ``tile_px`` is computed in tiles, each with a margin as wide as the receptive radius.
    The heights are the same as if the whole layout were computed at once. A model without a receptive radius
    is called with the whole layout.
    """
    reach = model.reach_px
    ny, nx = layout_um.shape[-2:]
    if reach is None or max(ny, nx) <= tile_px:
        return model(layout_um)
    return predict_interior(model, pad_field(layout_um, reach, reach), tile_px)


def predict_interior(model: Simulator, layout_um: Tensor, tile_px: int = TILE_PX) -> Tensor:
    """Predict the height, µm, of the pixels that are at least the receptive radius r from the edge of the
    layout. For a layout of shape (batch, 1, ny, nx), the result has shape (batch, 1, ny - 2r, nx - 2r).

    The height is differentiable in the layout. The layout is divided into tiles whose sides are at most
    ``tile_px`` pixels. The division into tiles does not change the result.

    Raises:
        InputError: the model has no receptive radius, or the layout has no interior.
    """
    reach = model.reach_px
    if reach is None or min(layout_um.shape[-2:]) <= 2 * reach:
        raise InputError(
            f"interior of a print by {model.name}",
            got=f"{tuple(layout_um.shape[-2:])} px and a receptive radius of {reach} px",
            wanted="a layout wider than twice the radius",
        )
    ny, nx = (length - 2 * reach for length in layout_um.shape[-2:])
    rows = []
    for y in range(0, ny, tile_px):
        stop = min(y + tile_px, ny)
        tiles = [
            model.interior(layout_um[..., y : stop + 2 * reach, x : min(x + tile_px, nx) + 2 * reach])
            for x in range(0, nx, tile_px)
        ]
        rows.append(torch.cat(tiles, dim=-1))
    return torch.cat(rows, dim=-2)


def predict_inside(model: Simulator, layout_um: Tensor, border_px: int) -> Tensor:
    """Predict the height, µm, of the pixels that are at least ``border_px`` pixels from the edge of the
    layout. The height is differentiable in the layout.

    The border must be less than half as wide as the layout. The result is the height that ``predict_field``
    returns, cropped by this border. If the model allows it, only the pixels of the result are computed (see
    ``FrozenSimulator.inside``).
    """
    reach = model.reach_px
    if reach is None:
        return model.inside(layout_um, border_px)
    if border_px < reach:
        return crop_border(predict_field(model, layout_um), border_px)
    return predict_interior(model, crop_border(layout_um, border_px - reach))


def blend_tiles(
    function: Callable[[Tensor], Tensor], layout_um: Tensor, tile: Tile, border_px: int = 0
) -> Tensor:
    """Compute ``function`` on overlapping tiles of a layout and blend the results. At each pixel, the result
    is a weighted mean over the tiles that contain it, with weights that add up to one.

    The layout is extended by repeating its outermost pixels, and the first tile starts ``overlap_px`` pixels
    outside the layout. The weights therefore also add up to one at the edge of the layout.

    Args:
        function: receives tiles of shape (batch, 1, T, T) and returns heights of the same shape.
        layout_um: layout of any size, µm, with shape (batch, 1, ny, nx).
        tile: side T of the tiles and their overlap.
        border_px: width, in pixels, of the border that is cropped from each side of the result. This width
            must be less than half the width of the layout. Tiles that lie entirely in the border are not
            computed.

    Raises:
        InputError: the overlap is more than half a tile.
    """
    size, overlap = tile
    stride = size - overlap
    window = blending_window(tile, layout_um)
    # Positions are counted from the start of the first tile, which is ``overlap`` pixels before the layout.
    (top, bottom), (left, right) = (
        (overlap + border_px, overlap + length - border_px) for length in layout_um.shape[-2:]
    )
    rows, columns = (
        range(max(0, (start - size) // stride + 1), (stop - 1) // stride + 1)
        for start, stop in ((top, bottom), (left, right))
    )
    missing = [
        max(0, wanted[-1] * stride + size - overlap - length)
        for wanted, length in zip((columns, rows), layout_um.shape[:-3:-1], strict=True)
    ]
    whole = functional.pad(layout_um, (overlap, missing[0], overlap, missing[1]), mode="replicate")
    first = columns[0] * stride
    strips = whole[..., first : columns[-1] * stride + size]
    batch, width = len(layout_um), strips.shape[-1]
    blended = layout_um.new_zeros(batch, 1, bottom - top, width)
    for y in (row * stride for row in rows):
        tiles = strips[..., y : y + size, :].unfold(-1, size, stride).permute(0, 3, 1, 2, 4)
        kept = slice(max(0, top - y), min(size, bottom - y))
        heights = (function(tiles.reshape(-1, 1, size, size)) * window)[..., kept, :]
        count = kept.stop - kept.start
        folded = functional.fold(
            heights.reshape(batch, len(columns), count * size).transpose(1, 2),
            (count, width),
            (count, size),
            stride=(count, stride),
        )
        blended[..., y + kept.start - top : y + kept.stop - top, :] += folded
    return blended[..., left - first : right - first]


def blending_window(tile: Tile, like: Tensor) -> Tensor:
    """Return the weight of each pixel of a tile for blending. The result has shape (T, T), where T is the
    side of the tile. Across the overlap, the weight rises as sin², so that the weights of two neighbouring
    tiles add up to one.

    Raises:
        InputError: the overlap is more than half a tile.
    """
    size, overlap = tile
    if not 0 <= 2 * overlap <= size:
        raise InputError("overlap of tiles", got=f"{overlap} px", wanted=f"0 to {size // 2} px, half a tile")
    phase = (torch.arange(overlap, device=like.device, dtype=like.dtype) + 0.5) / max(1, overlap)
    ramp = torch.sin(torch.pi / 2 * phase) ** 2
    line = torch.cat(
        [ramp, torch.ones(size - 2 * overlap, device=like.device, dtype=like.dtype), ramp.flip(0)]
    )
    return torch.outer(line, line)


def predict_scan(model: Simulator, scan: PrintedScan) -> np.ndarray:
    """Predict the printed height of one scan from its exposure, without gradients. The result is in µm,
    float32 of shape (ny, nx).
    """
    device = next(model.parameters(), torch.empty(0)).device
    with torch.no_grad():
        layout = torch.from_numpy(scan.exposed_um)[None, None].to(device)
        return predict_field(model, layout)[0, 0].float().cpu().numpy()
