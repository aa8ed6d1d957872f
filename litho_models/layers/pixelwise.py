"""Functions that see each pixel alone, block after block of pixels, so that hidden values stay few."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.utils.checkpoint import checkpoint

# A hundred hidden values of so many pixels take 3 MB, which stay in the last cache.
_PIXELS_AT_ONCE = 2**13


def at_each_pixel(function: Callable[..., Tensor], *features: Tensor, parameters: Iterable[Tensor]) -> Tensor:
    """``function`` of all pixels, (n,); gradients flow to the features.

    Args:
        function: maps features of any number m of pixels, (m, ...) each, to m values, (m,).
        features: (n, ...) each.
        parameters: what the function holds; gradients flow to those that learn, too.
    """
    learns = any(parameter.requires_grad for parameter in parameters)
    if not learns and any(feature.requires_grad for feature in features):
        values: Tensor = _WithSlopes.apply(function, *features)
        return values
    if torch.is_grad_enabled():
        # Computed again for a gradient: the hidden values of a field would take gigabytes.
        parts = [checkpoint(function, *block, use_reentrant=False) for block in _in_blocks(features)]
    else:
        parts = [function(*block) for block in _in_blocks(features)]
    return torch.cat(parts)


class _WithSlopes(torch.autograd.Function):
    """What is left for the way back are the slopes, found along with the values.

    They take as much memory as the features, and no second pass over the pixels.
    """

    @staticmethod
    def forward(ctx: Any, function: Callable[..., Tensor], *features: Tensor) -> Tensor:
        values: list[Tensor] = []
        slopes: list[Sequence[Tensor]] = []
        for block in _in_blocks(features):
            with torch.enable_grad():
                seen = [feature.detach().requires_grad_() for feature in block]
                value = function(*seen)
                slopes.append(torch.autograd.grad(value.sum(), seen))
            values.append(value.detach())
        ctx.save_for_backward(*(torch.cat(parts) for parts in zip(*slopes, strict=True)))
        return torch.cat(values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return None, *(slope * gradient.view(-1, *(1,) * (slope.dim() - 1)) for slope in ctx.saved_tensors)


def _in_blocks(features: Sequence[Tensor]) -> Iterator[tuple[Tensor, ...]]:
    """Block after block of pixels: the features of each, (m, ...)."""
    return zip(*(feature.split(_PIXELS_AT_ONCE) for feature in features), strict=True)
