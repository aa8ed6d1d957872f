"""A stack of 3 x 3 convolutions with fixed weights, in small tiles: what a design through it costs.

Where the weights are fixed, the gradient with respect to the input needs the sign of each hidden
value and nothing else. So each tile runs while its features lie in the cache, keeps its signs (as the
features themselves in bfloat16, rounding keeps a sign), and is forgotten.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

# 64 channels of 128 x 128 pixels are 4 MiB; larger tiles leave the cache, smaller ones repeat more halo.
_TILE_PX = 128


@dataclass(frozen=True)
class FixedStack:
    """Weights of 1 -> channels -> 1, 3 x 3 each, leaky ReLU after each but the last.

    Args:
        weights: (outputs, inputs, 3, 3) per layer, at least two.
        biases: (outputs,) per layer.
        leaky_slope: slope below zero, above 0.
        hidden_dtype: of the layers between the first and the last; these two keep full precision.
        adjoint_dtype: of the same layers on the way back.
    """

    weights: Sequence[Tensor]
    biases: Sequence[Tensor]
    leaky_slope: float
    hidden_dtype: torch.dtype
    adjoint_dtype: torch.dtype

    def __call__(self, field: Tensor) -> Tensor:
        """Interior of ``field`` (b, 1, y, x): (b, 1, y - 2n, x - 2n) for n layers; gradient to ``field``."""
        return _Stack.apply(field, self)

    @property
    def halo_px(self) -> int:
        """Pixels that the interior is smaller by, on each side."""
        return len(self.weights)


class _Stack(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, field: Tensor, stack: FixedStack) -> Tensor:
        ctx.stack, ctx.shape = stack, field.shape
        keep = field.requires_grad
        hidden = _channels_last(stack.weights[1:-1], stack.hidden_dtype)
        biases = [bias.to(stack.hidden_dtype) for bias in stack.biases[1:-1]]
        halo = 2 * stack.halo_px
        out = field.new_empty((len(field), 1, field.shape[-2] - halo, field.shape[-1] - halo))
        signs: list[Tensor] = []
        for rows, columns in _tiles(out.shape[-2], out.shape[-1]):
            tile = field[..., rows.start : rows.stop + halo, columns.start : columns.stop + halo]
            features = _from_one_channel(tile, stack.weights[0], stack.biases[0])
            features = functional.leaky_relu_(features, stack.leaky_slope).to(stack.hidden_dtype)
            kept = [_signs(features)] if keep else []
            for weight, bias in zip(hidden, biases, strict=True):
                features = functional.leaky_relu_(
                    functional.conv2d(features, weight, bias), stack.leaky_slope
                )
                if keep:
                    kept.append(_signs(features))
            signs += kept
            out[..., rows, columns] = _onto_one_channel(features.to(field.dtype), stack.weights[-1])
        out += stack.biases[-1]
        ctx.save_for_backward(*signs)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        stack: FixedStack = ctx.stack
        # The adjoint of a convolution is the convolution with the kernel turned round, on a wider frame.
        turned = [weight.flip(2, 3).transpose(0, 1) for weight in stack.weights]
        hidden = _channels_last(turned[1:-1], stack.adjoint_dtype)
        last = turned[-1].contiguous(memory_format=torch.channels_last)
        halo, layers = 2 * stack.halo_px, len(stack.weights) - 1
        total = gradient.new_zeros(ctx.shape)
        for index, (rows, columns) in enumerate(_tiles(gradient.shape[-2], gradient.shape[-1])):
            signs = ctx.saved_tensors[index * layers : (index + 1) * layers]
            tile = gradient[..., rows, columns].contiguous(memory_format=torch.channels_last)
            slope = functional.conv2d(tile, last, padding=2).to(stack.adjoint_dtype)
            for weight, sign in zip(reversed(hidden), reversed(signs[1:]), strict=True):
                slope = functional.conv2d(_through_relu(slope, sign, stack.leaky_slope), weight, padding=2)
            slope = _through_relu(slope.to(gradient.dtype), signs[0], stack.leaky_slope)
            inside = total[..., rows.start : rows.stop + halo, columns.start : columns.stop + halo]
            _add_onto_one_channel(slope, stack.weights[0], inside)
        return total, None


def _from_one_channel(tile: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Convolution 1 -> channels as a matrix product, which leaves channels last: (b, c, y - 2, x - 2)."""
    batch, _, ny, nx = tile.shape
    patches = functional.unfold(tile, 3).transpose(1, 2).reshape(-1, 9)
    features = torch.addmm(bias, patches, weight.reshape(-1, 9).T)
    return features.view(batch, ny - 2, nx - 2, -1).permute(0, 3, 1, 2)


def _onto_one_channel(features: Tensor, weight: Tensor) -> Tensor:
    """Convolution channels -> 1: one product for all nine taps, then nine shifted sums."""
    taps = _taps(features, weight.reshape(-1, 9))
    ny, nx = (length - 2 for length in features.shape[-2:])
    total = torch.zeros_like(taps[0, :, :ny, :nx])
    for index, tap in enumerate(taps):
        y, x = divmod(index, 3)
        total += tap[:, y : y + ny, x : x + nx]
    return total[:, None]


def _add_onto_one_channel(slope: Tensor, weight: Tensor, total: Tensor) -> None:
    """Add the adjoint of ``_from_one_channel`` to ``total``, in place."""
    ny, nx = slope.shape[-2:]
    for index, tap in enumerate(_taps(slope, weight.reshape(-1, 9))):
        y, x = divmod(index, 3)
        total[:, 0, y : y + ny, x : x + nx] += tap


def _taps(features: Tensor, weight: Tensor) -> Tensor:
    """(9, b, y, x): each of nine weightings of the channels; ``weight`` is (channels, 9)."""
    batch, channels, ny, nx = features.shape
    pixels = features.permute(0, 2, 3, 1).reshape(-1, channels)
    return torch.mm(weight.T, pixels.T).view(9, batch, ny, nx)


def _signs(features: Tensor) -> Tensor:
    return features.to(torch.bfloat16)


def _through_relu(slope: Tensor, sign: Tensor, leaky_slope: float) -> Tensor:
    return torch.ops.aten.leaky_relu_backward(slope, sign.to(slope.dtype), leaky_slope, True)


def _channels_last(weights: Sequence[Tensor], dtype: torch.dtype) -> list[Tensor]:
    return [weight.to(dtype).contiguous(memory_format=torch.channels_last) for weight in weights]


def _tiles(rows_px: int, columns_px: int) -> Iterator[tuple[slice, slice]]:
    for rows in _equal_parts(rows_px):
        for columns in _equal_parts(columns_px):
            yield rows, columns


def _equal_parts(length_px: int) -> list[slice]:
    count = max(1, math.ceil(length_px / _TILE_PX))
    edges = [round(length_px * part / count) for part in range(count + 1)]
    return [slice(start, stop) for start, stop in pairwise(edges)]
