"""3 x 3 convolutions from or onto a single channel, as products of matrices.

A general convolution is slow at them: its loops are made for many channels on both sides.
"""

from __future__ import annotations

import torch
from torch import Tensor


def from_one_channel(tile: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Convolution 1 -> channels as a matrix product, which leaves channels last: (1, c, y - 2, x - 2)."""
    ny, nx = (length - 2 for length in tile.shape[-2:])
    kernel = torch.cat([weight.reshape(-1, 9), bias[:, None]], dim=1)
    return (_neighbours(tile).T @ kernel.T).view(1, ny, nx, -1).permute(0, 3, 1, 2)


def correlation(tile: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of ``from_one_channel`` to its weight (c, 1, 3, 3) and bias, for that of its result."""
    sums = (_neighbours(tile).to(features.dtype) @ _pixels(features)).T.to(tile.dtype)
    return sums[:, :9].reshape(-1, 1, 3, 3), sums[:, 9]


def onto_one_channel(features: Tensor, weight: Tensor) -> Tensor:
    """Convolution channels -> 1: one product for all nine taps, then nine shifted sums; (y - 2, x - 2)."""
    taps = _taps(features, weight)
    ny, nx = (length - 2 for length in features.shape[-2:])
    total = torch.zeros_like(taps[0, :ny, :nx])
    for index, tap in enumerate(taps):
        y, x = divmod(index, 3)
        total += tap[y : y + ny, x : x + nx]
    return total


def adjoint_onto_one_channel(slope: Tensor, weight: Tensor) -> Tensor:
    """Adjoint of ``from_one_channel`` for (1, c, y, x): (y + 2, x + 2)."""
    ny, nx = slope.shape[-2:]
    total = weight.new_zeros((ny + 2, nx + 2))
    for index, tap in enumerate(_taps(slope, weight.to(slope.dtype)).to(total.dtype)):
        y, x = divmod(index, 3)
        total[y : y + ny, x : x + nx] += tap
    return total


def adjoint_kernel(weight: Tensor) -> Tensor:
    """Kernel that takes a convolution back, on a wider frame: turned round, inputs and outputs exchanged."""
    return weight.flip(2, 3).transpose(0, 1)


def _neighbours(tile: Tensor) -> Tensor:
    """(10, pixels): 3 x 3 surroundings of each pixel of (1, 1, y, x) but the outermost; ones for a bias."""
    ny, nx = (length - 2 for length in tile.shape[-2:])
    shifted = [tile[..., y : y + ny, x : x + nx] for y in range(3) for x in range(3)]
    return torch.cat([*shifted, torch.ones_like(shifted[0])]).view(10, -1)


def _taps(features: Tensor, weight: Tensor) -> Tensor:
    """(9, y, x): each of nine weightings of the channels of (1, c, y, x)."""
    by_tap = weight.reshape(-1, 9).T
    return torch.mm(by_tap, _pixels(features).T).view(9, *features.shape[-2:])


def _pixels(features: Tensor) -> Tensor:
    """(y x, c) of (1, c, y, x)."""
    return features.permute(0, 2, 3, 1).reshape(-1, features.shape[1])
