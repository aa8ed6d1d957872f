"""Check that a function of single pixels gives the same values and gradients in blocks as at once."""

from __future__ import annotations

import pytest
import torch

from litho_models.layers import pixelwise
from litho_models.layers.pixelwise import at_each_pixel

pytestmark = pytest.mark.numerics


@pytest.mark.parametrize("learns", [False, True])
def test_blocks_change_neither_values_nor_gradients(learns, monkeypatch):
    # There are 7 blocks, of which the last is not full.
    monkeypatch.setattr(pixelwise, "_PIXELS_AT_ONCE", 16)
    torch.manual_seed(0)
    weight = torch.randn(5, dtype=torch.float64, requires_grad=learns)
    wide = torch.randn(100, 5, dtype=torch.float64, requires_grad=True)
    narrow = torch.randn(100, dtype=torch.float64, requires_grad=True)
    pull = torch.randn(100, dtype=torch.float64)
    seen = []

    def function(wide: torch.Tensor, narrow: torch.Tensor) -> torch.Tensor:
        seen.append(len(wide))
        return torch.tanh(wide @ weight) * narrow**2

    inputs = (wide, narrow, weight) if learns else (wide, narrow)
    wanted = function(wide, narrow)
    seen.clear()
    found = at_each_pixel(function, wide, narrow, parameters=[weight])
    assert max(seen) == 16
    assert sum(seen) == 100
    assert torch.equal(found.detach(), wanted.detach())
    # The sums have a hundred products of order one, in double precision.
    for slope, expected in zip(
        torch.autograd.grad(found @ pull, inputs), torch.autograd.grad(wanted @ pull, inputs), strict=True
    ):
        assert (slope - expected).abs().max() < 1e-12


def test_fixed_weights_keep_nothing_of_the_hidden_values():
    features = torch.randn(1000, 3, requires_grad=True)
    hidden = torch.randn(3, 64)
    found = at_each_pixel(lambda some: torch.tanh(some @ hidden).sum(-1), features, parameters=[hidden])
    assert [kept.shape for kept in found.grad_fn.saved_tensors] == [features.shape]
