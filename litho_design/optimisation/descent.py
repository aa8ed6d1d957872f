"""Gradient descent on a few free parameters, for baselines that need no printer."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


# Descent needs gradients even if the caller disabled them, as most scores do.
@torch.enable_grad()
def descended(
    free: Iterable[Tensor],
    loss: Callable[[], tuple[Tensor, T]],
    *,
    rate: float,
    iterations: int,
    project: Callable[[], object] = lambda: None,
) -> tuple[T, float]:
    """Minimise ``loss`` by Adam; return the result of the step with the lowest loss, and that loss.

    Args:
        free: the numbers to change, in place.
        loss: function that returns the loss at the current numbers, and a result. Later steps must not change
            this result.
        project: called after every step, to bring the numbers back into their range.
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
