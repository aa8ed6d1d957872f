"""Functions of one scalar per pixel, evaluated on knots and interpolated linearly."""

from __future__ import annotations

from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn


def interpolate(values: Tensor, knot_heights: Tensor, lowest: float, highest: float) -> Tensor:
    """Piecewise-linear function of ``values``, any shape; differentiable in the values and in the knots.

    Args:
        values: where to evaluate.
        knot_heights: function at ``len(knot_heights)`` equally spaced knots from ``lowest`` to
            ``highest``; beyond them the outermost segment continues.
    """
    last = knot_heights.numel() - 1
    position = (values - lowest) * (last / (highest - lowest))
    index = position.detach().floor().clamp(0, last - 1)
    flat = index.flatten().long()
    lower = knot_heights.index_select(0, flat).reshape(values.shape)
    upper = knot_heights.index_select(0, flat + 1).reshape(values.shape)
    return lower + (upper - lower) * (position - index)


class PointwiseNet(nn.Module):
    """A network of one scalar, 1 -> hidden layers -> 1, the same for all pixels (1 x 1 convolutions).

    It is a function of one variable, and a piecewise-linear one; so it is evaluated on ``knots``
    points and interpolated, which needs a thousand evaluations rather than one per pixel.
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
        """Evaluate by interpolation; ``lowest`` ... ``highest`` is the range that the knots span."""
        return interpolate(values, self.at_knots(lowest, highest), lowest, highest)

    def at_knots(self, lowest: float, highest: float) -> Tensor:
        """The network at the knots, shape (knots,)."""
        parameter = next(self.parameters())
        points = torch.linspace(lowest, highest, self.knots, device=parameter.device, dtype=parameter.dtype)
        return self.exact(points)

    def exact(self, values: Tensor) -> Tensor:
        """Evaluate the network itself for every value, any shape."""
        with torch.autocast(device_type=values.device.type, enabled=False):
            return self.layers(values.reshape(-1, 1)).reshape(values.shape)

    def start_at_zero(self) -> None:
        """Make the network the zero function, keeping its hidden layers random."""
        last = cast(nn.Linear, self.layers[-1])
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
