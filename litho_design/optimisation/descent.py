"""Gradient descent on free parameters, for baselines and other quantities outside the search."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


# The descent needs gradients, but most functions that compute scores disable them.
@torch.enable_grad()
def descended(
    free: Iterable[Tensor],
    loss: Callable[[], tuple[Tensor, T]],
    *,
    rate: float,
    iterations: int,
    project: Callable[[], object] = lambda: None,
) -> tuple[T, float]:
    """Minimise a loss by Adam. Return a pair: the result of the step with the lowest loss, and this loss.

    Args:
        free: the tensors whose values are changed, in place.
        loss: function that returns the loss at the current values, and a result computed from these values.
            Later steps must not change this result.
        project: function that is called after every step, to bring the values back into their range.
    """
    optimiser = torch.optim.Adam(free, lr=rate)
    found: tuple[T, float] | None = None
    for _ in range(iterations):
        value, result = loss()
        if found is None or float(value.detach()) < found[1]:
            found = result, float(value.detach())
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        project()
    assert found is not None, "no iteration"
    return found
