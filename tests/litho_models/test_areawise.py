"""The fixed stack of convolutions is the network it stands for, forwards and backwards, tile by tile."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from torch.nn import functional

from litho_models.areawise import FixedStack
from litho_models.freeze import load_frozen, save_frozen
from litho_models.models import build_model

SLOPE = 0.02


def make_stack(adjoint: torch.dtype, dtype: torch.dtype = torch.float64) -> FixedStack:
    generator = torch.Generator().manual_seed(0)
    widths = (1, 6, 4, 5, 1)
    weights = [
        torch.randn(b, a, 3, 3, generator=generator, dtype=torch.float64).to(dtype) / (9 * a) ** 0.5
        for a, b in pairwise(widths)
    ]
    biases = [torch.randn(b, generator=generator, dtype=torch.float64).to(dtype) for b in widths[1:]]
    return FixedStack(weights, biases, SLOPE, dtype, adjoint)


def by_autograd(stack: FixedStack, field: torch.Tensor) -> torch.Tensor:
    for index, (weight, bias) in enumerate(zip(stack.weights, stack.biases, strict=True)):
        field = functional.conv2d(field, weight, bias)
        field = field if index == 3 else functional.leaky_relu(field, SLOPE)
    return field


@pytest.mark.parametrize("shape", [(1, 1, 20, 23), (2, 1, 150, 300)])
def test_it_is_the_plain_stack_and_its_gradient(shape):
    # The larger field has 2 x 3 tiles of unequal sides, whose halos overlap in the gradient.
    stack = make_stack(torch.float64)
    generator = torch.Generator().manual_seed(1)
    field = torch.randn(shape, generator=generator, dtype=torch.float64)
    ours, plain = field.clone().requires_grad_(), field.clone().requires_grad_()
    height, expected = stack(ours), by_autograd(stack, plain)
    assert height.shape == (shape[0], 1, shape[2] - 8, shape[3] - 8)
    # The same sums in another order: 54 terms of order one in double precision.
    assert torch.allclose(height, expected, rtol=0, atol=1e-13)
    weight = torch.randn(height.shape, generator=generator, dtype=torch.float64)
    height.backward(weight)
    expected.backward(weight)
    assert torch.allclose(ours.grad, plain.grad, rtol=0, atol=1e-12)


def test_a_reduced_adjoint_leaves_the_height_alone_and_the_gradient_close():
    exact, reduced = make_stack(torch.float32, torch.float32), make_stack(torch.bfloat16, torch.float32)
    field = torch.randn(1, 1, 200, 200, generator=torch.Generator().manual_seed(2))
    gradients = []
    for stack in (exact, reduced):
        given = field.clone().requires_grad_()
        height = stack(given)
        height.square().sum().backward()
        gradients.append((height.detach(), given.grad))
    assert torch.equal(gradients[0][0], gradients[1][0])
    # bfloat16 rounds by up to 2^-9 of a value; weights, slopes and results of three layers add up to
    # at most 9 such roundings.
    error = (gradients[1][1] - gradients[0][1]).norm() / gradients[0][1].norm()
    assert 0 < float(error) < 9 * 2**-9


def test_without_a_gradient_nothing_is_kept():
    stack = make_stack(torch.float64)
    height = stack(torch.zeros(1, 1, 20, 20, dtype=torch.float64))
    assert height.grad_fn is None


def test_a_frozen_pbl_prints_what_the_trained_one_does(tmp_path):
    torch.manual_seed(0)
    model = build_model("pbl", sigma_diffusion_init_um=0.2)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.03 * torch.randn_like(parameter))
    layout = torch.randint(0, 13, (1, 1, 160, 170)) * 0.1
    trained = model(layout)
    assert trained.grad_fn is not None
    frozen = load_frozen(save_frozen(model, tmp_path / "pbl"))
    assert torch.allclose(frozen(layout), trained.detach(), atol=1e-6)
    reach = model.reach_px
    assert frozen.has_interior
    inside = frozen.interior(layout)
    assert inside.shape == (1, 1, 160 - 2 * reach, 170 - 2 * reach)
    assert torch.allclose(inside, trained.detach()[..., reach:-reach, reach:-reach], atol=1e-6)
