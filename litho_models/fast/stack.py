"""A stack of 3 x 3 convolutions on a CPU, in tiles whose features lie in the cache of one core.

Of each tile is kept what the gradient needs, in as few bytes as will do: where the weights are fixed
the sign of each hidden value and nothing else (or the value in bfloat16: rounding keeps a sign), where
they learn the values themselves. Fixed weights in float32 run with fewer multiplications.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from litho_models.fast.one_channel import (
    adjoint_kernel,
    adjoint_onto_one_channel,
    correlation,
    from_one_channel,
    onto_one_channel,
)
from litho_models.fast.threads import one_thread_each

if TYPE_CHECKING:
    from litho_models.fast.winograd import FixedStack

# 64 channels of 96 x 96 pixels are 1.1 MiB in bfloat16; larger tiles leave the cache, smaller ones repeat
# more halo. Fixed weights in float32 run on blocks of a tile, so that it may be larger (on the way back in
# bfloat16 as well, where both sizes are as fast).
_TILE_PX, _FIXED_TILE_PX = 96, 128
# LANES of `winograd_passes`, which would load Numba.
_VECTOR = 16
# Inputs of the function before the weights.
_OTHER_INPUTS = 3


class _Settings(NamedTuple):
    leaky_slope: float
    hidden_dtype: torch.dtype
    adjoint_dtype: torch.dtype


def convolution_stack(
    field: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    *,
    leaky_slope: float,
    hidden_dtype: torch.dtype,
    adjoint_dtype: torch.dtype,
) -> Tensor:
    """Interior of ``field`` (b, 1, y, x): (b, 1, y - 2n, x - 2n) for n layers, leaky ReLU between them.

    On one processor the result and its gradients are the same bits for every number of threads.

    Args:
        field: on the CPU, in the dtype of the weights; gradients flow back to it, once.
        weights: (outputs, inputs, 3, 3) per layer, 1 -> channels -> 1, two layers at least; they learn
            where one of them or of the biases wants a gradient.
        biases: (outputs,) per layer.
        leaky_slope: slope below zero, above 0.
        hidden_dtype: of the layers between the first and the last; forwards these two keep the field's.
        adjoint_dtype: of the same layers on the way back.
    """
    settings = _Settings(leaky_slope, hidden_dtype, adjoint_dtype)
    # Within the function gradients are always off.
    return _Stack.apply(field, settings, torch.is_grad_enabled(), *weights, *biases)


class _Stack(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, field: Tensor, settings: _Settings, records: bool, *parameters: Tensor) -> Tensor:
        slope, dtype = settings.leaky_slope, settings.hidden_dtype
        weights, biases = _halves(parameters)
        hidden = _channels_last(weights[1:-1], dtype)
        hidden_biases = [bias.to(dtype) for bias in biases[1:-1]]
        # True of weights in training also where no gradient is recorded: one model, one rounding.
        learns = any(ctx.needs_input_grad[_OTHER_INPUTS:])
        keeps = records and (learns or ctx.needs_input_grad[0])
        kept_dtype = settings.adjoint_dtype if learns else torch.bfloat16
        halo = 2 * len(weights)
        out = field.new_empty((len(field), 1, field.shape[-2] - halo, field.shape[-1] - halo))
        fixed = None if learns or dtype != torch.float32 else _fixed_stack(field, weights, biases, slope)
        tile_px = _TILE_PX if fixed is None else _FIXED_TILE_PX
        tiles = list(_tiles(out, halo, tile_px))

        def compute(tile: int) -> tuple[Tensor, list[Tensor]]:
            _, around = tiles[tile]
            if fixed is not None:
                heights, signs = fixed.heights(field[around][0, 0])
                return heights, signs if keeps else []
            features = from_one_channel(field[around], weights[0], biases[0])
            features = functional.leaky_relu_(features, slope).to(dtype)
            values = [features.to(kept_dtype)] if keeps else []
            for weight, bias in zip(hidden, hidden_biases, strict=True):
                features = functional.leaky_relu_(functional.conv2d(features, weight, bias), slope)
                values += [features.to(kept_dtype)] if keeps else []
            return onto_one_channel(features.to(field.dtype), weights[-1]), values

        kept: list[Tensor] = []
        computed = one_thread_each(compute, len(tiles))
        for (inside, _), (heights, values) in zip(tiles, computed, strict=True):
            out[inside] = heights
            kept += values
        out += biases[-1]
        ctx.settings, ctx.learns, ctx.tile_px = settings, learns, tile_px
        ctx.fixed = fixed if keeps and settings.adjoint_dtype == torch.float32 else None
        if fixed is not None:
            fixed.free_rooms()
        ctx.save_for_backward(field, *parameters, *kept)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        settings: _Settings = ctx.settings
        dtype, learns = settings.adjoint_dtype, ctx.learns
        count = len(ctx.needs_input_grad) - _OTHER_INPUTS
        field, *saved = ctx.saved_tensors
        parameters, kept = saved[:count], saved[count:]
        weights = parameters[: count // 2]
        hidden = _channels_last(weights[1:-1], dtype)
        last = adjoint_kernel(weights[-1])
        no_bias = last.new_zeros(len(last))
        halo, layers = 2 * len(weights), len(weights) - 1
        tiles = list(_tiles(gradient, halo, ctx.tile_px))
        fixed: FixedStack | None = ctx.fixed

        def compute(tile: int) -> tuple[Tensor | None, list[tuple[Tensor, Tensor]]]:
            inside, around = tiles[tile]
            own = kept[tile * layers : (tile + 1) * layers]
            if fixed is not None:
                return fixed.adjoint(gradient[inside][0, 0], own), []
            ny, nx = gradient[inside].shape[-2:]
            frames = range(2 * layers, 0, -2)
            values = [
                value[..., : ny + frame, : nx + frame].to(dtype)
                for value, frame in zip(own, frames, strict=True)
            ]
            above = functional.pad(gradient[inside], (2, 2, 2, 2))
            slope = from_one_channel(above, last, no_bias).to(dtype)
            shares: list[tuple[Tensor, Tensor]] = []
            if learns:
                by_weight, _ = correlation(above, values[-1])
                shares.append((adjoint_kernel(by_weight), gradient[inside].sum()))
            for layer in range(layers - 1, 0, -1):
                _through_relu_(slope, values[layer], settings.leaky_slope)
                slope, by_weight, by_bias = _convolution_backward(
                    slope, values[layer - 1], hidden[layer - 1], learns
                )
                shares += [(by_weight, by_bias)] if learns else []
            _through_relu_(slope, values[0], settings.leaky_slope)
            shares += [correlation(field[around], slope)] if learns else []
            wanted = ctx.needs_input_grad[0]
            return adjoint_onto_one_channel(slope, weights[0]) if wanted else None, shares[::-1]

        total = torch.zeros_like(field)
        sums = [torch.zeros_like(parameter) for parameter in parameters]
        computed = one_thread_each(compute, len(tiles))
        for (_, around), (by_field, shares) in zip(tiles, computed, strict=True):
            if by_field is not None:
                total[around] += by_field
            if learns:
                for parameter_sum, share in zip(sums, chain(*zip(*shares, strict=True)), strict=True):
                    parameter_sum += share
        if fixed is not None:
            fixed.free_rooms()
        return total, None, None, *(sums if learns else [None] * count)


def _fixed_stack(
    field: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], leaky_slope: float
) -> FixedStack | None:
    """For a field and weights of float32 and channels that fill vectors, else None."""
    if field.dtype != torch.float32 or any(len(weight) % _VECTOR for weight in weights[:-1]):
        return None
    # Numba takes a moment to load, and much here runs without it.
    from litho_models.fast.winograd import FixedStack

    return FixedStack(weights, biases, leaky_slope, _FIXED_TILE_PX)


def _halves(items: Sequence[Tensor]) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    return items[: len(items) // 2], items[len(items) // 2 :]


def _convolution_backward(
    slope: Tensor, features: Tensor, weight: Tensor, learns: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of a convolution to its input, weight and bias; the last two only where it learns."""
    return torch.ops.aten.convolution_backward(
        slope,
        features,
        weight,
        [len(weight)],
        stride=[1, 1],
        padding=[0, 0],
        dilation=[1, 1],
        transposed=False,
        output_padding=[0, 0],
        groups=1,
        output_mask=[True, learns, learns],
    )


def _through_relu_(slope: Tensor, values: Tensor, leaky_slope: float) -> None:
    torch.ops.aten.leaky_relu_backward.grad_input(slope, values, leaky_slope, True, grad_input=slope)


def _channels_last(weights: Sequence[Tensor], dtype: torch.dtype) -> list[Tensor]:
    return [weight.to(dtype).contiguous(memory_format=torch.channels_last) for weight in weights]


def _tiles(out: Tensor, halo_px: int, size_px: int) -> Iterator[tuple[tuple[slice, ...], tuple[slice, ...]]]:
    """Slices of each tile in the result (b, 1, y, x), and of what it depends on in the wider input."""
    every = slice(None)
    for sample in range(len(out)):
        one = slice(sample, sample + 1)
        for rows in _equal_parts(out.shape[-2], size_px):
            for columns in _equal_parts(out.shape[-1], size_px):
                wide = [slice(part.start, part.stop + halo_px) for part in (rows, columns)]
                yield (one, every, rows, columns), (one, every, *wide)


def _equal_parts(length_px: int, size_px: int) -> list[slice]:
    count = max(1, math.ceil(length_px / size_px))
    edges = [round(length_px * part / count) for part in range(count + 1)]
    return [slice(start, stop) for start, stop in pairwise(edges)]
