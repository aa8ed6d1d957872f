"""Evaluate functions that act on each pixel separately. Pixels are evaluated in blocks, which limits the
memory for the hidden values of networks.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.utils.checkpoint import checkpoint

# Number of pixels in a block. A hundred hidden values for each of these pixels take 3 MB and fit into the
# last-level cache of a processor.
_PIXELS_AT_ONCE = 2**13


def at_each_pixel(function: Callable[..., Tensor], *features: Tensor, parameters: Iterable[Tensor]) -> Tensor:
    """Evaluate a function of the features of a pixel at all n pixels. The result has shape (n,). Gradients
    flow to the features.

    Args:
        function: receives the features of m pixels, as tensors of shape (m, ...), and returns one value per
            pixel, of shape (m,). The function must accept any m.
        features: tensors of shape (n, ...), with one row for each pixel.
        parameters: parameters of the function. Gradients flow to those parameters that are trained.
    """
    learns = any(parameter.requires_grad for parameter in parameters)
    if not learns and any(feature.requires_grad for feature in features):
        values: Tensor = _WithSlopes.apply(function, *features)
        return values
    if torch.is_grad_enabled():
        # The backward pass computes the hidden values again, because storing them for a whole field would
        # take gigabytes.
        parts = [checkpoint(function, *block, use_reentrant=False) for block in _in_blocks(features)]
    else:
        parts = [function(*block) for block in _in_blocks(features)]
    return torch.cat(parts)


class _WithSlopes(torch.autograd.Function):
    """An operation that computes the values of a function and their slopes, i.e. their derivatives with
    respect to the features. Only the slopes are kept for the backward pass.

    The slopes take as much memory as the features. With them, the backward pass need not evaluate the
    function again.
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
    """Yield the features of each block of m pixels, as tensors of shape (m, ...)."""
    return zip(*(feature.split(_PIXELS_AT_ONCE) for feature in features), strict=True)


def interpolate(values: Tensor, knot_heights: Tensor, lowest: float, highest: float) -> Tensor:
    """Evaluate a piecewise-linear function. The result has the shape of ``values``, and is differentiable in
    the values and in the heights of the knots.

    Args:
        values: points at which the function is evaluated, as a tensor of any shape.
        knot_heights: values of the function at equally spaced knots, the first at ``lowest`` and the last at
            ``highest``. Beyond the knots, the outermost segments are extended.
    """
    last = knot_heights.numel() - 1
    position = (values - lowest) * (last / (highest - lowest))
    index = position.detach().floor().clamp(0, last - 1)
    flat = index.flatten().long()
    lower = knot_heights.index_select(0, flat).reshape(values.shape)
    upper = knot_heights.index_select(0, flat + 1).reshape(values.shape)
    return lower + (upper - lower) * (position - index)


class PointwiseNet(nn.Module):
    """A network with one input and one output, which is applied to each pixel separately (1 x 1
    convolutions).

    The network is a piecewise-linear function of one variable, and is therefore evaluated only at ``knots``
    points (about a thousand) instead of at every pixel. Between these points, its values are interpolated.
    """

    def __init__(self, hidden: tuple[int, ...], leaky_slope: float, knots: int):
        super().__init__()
        widths = (1, *hidden, 1)
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(widths):
            layers += [nn.Linear(inputs, outputs), nn.LeakyReLU(leaky_slope)]
        self.layers = nn.Sequential(*layers[:-1])
        self.knots = knots

    def forward(self, values: Tensor, lowest: float, highest: float) -> Tensor:
        """Evaluate the network at ``values`` by interpolation between knots, which span the range from
        ``lowest`` to ``highest``.
        """
        return interpolate(values, self.at_knots(lowest, highest), lowest, highest)

    def at_knots(self, lowest: float, highest: float) -> Tensor:
        """Return the values of the network at the knots, with shape (knots,)."""
        parameter = next(self.parameters())
        points = torch.linspace(lowest, highest, self.knots, device=parameter.device, dtype=parameter.dtype)
        return self.exact(points)

    def exact(self, values: Tensor) -> Tensor:
        """Evaluate the network itself, without interpolation, at values of any shape."""
        with torch.autocast(device_type=values.device.type, enabled=False):
            return self.layers(values.reshape(-1, 1)).reshape(values.shape)

    def start_at_zero(self) -> None:
        """Set the last layer to zero, so that the network returns zero before it is trained. The hidden
        layers stay random.
        """
        last = cast(nn.Linear, self.layers[-1])
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
