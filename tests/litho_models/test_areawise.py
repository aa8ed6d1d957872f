"""The stack of convolutions in tiles is the network it stands for, forwards and backwards."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import nn
from torch.nn import functional

from litho_models.fast import convolution_stack
from litho_models.frozen.files import load_frozen, save_frozen
from litho_models.models import build_model
from litho_models.models.pbl import AreawiseNet

pytestmark = pytest.mark.numerics

SLOPE = 0.02


def in_dtypes(hidden: torch.dtype, adjoint: torch.dtype) -> dict[str, Any]:
    return {"leaky_slope": SLOPE, "hidden_dtype": hidden, "adjoint_dtype": adjoint}


EXACT = in_dtypes(torch.float64, torch.float64)


def make_parameters(
    learns: bool, dtype: torch.dtype = torch.float64
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    generator = torch.Generator().manual_seed(0)
    widths = (1, 6, 4, 5, 1)
    weights = [
        torch.randn(b, a, 3, 3, generator=generator, dtype=torch.float64) / (9 * a) ** 0.5
        for a, b in pairwise(widths)
    ]
    biases = [torch.randn(b, generator=generator, dtype=torch.float64) for b in widths[1:]]
    return tuple([p.to(dtype).requires_grad_(learns) for p in half] for half in (weights, biases))


def by_autograd(field: torch.Tensor, weights: list[torch.Tensor], biases: list[torch.Tensor]) -> torch.Tensor:
    for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        field = functional.conv2d(field, weight, bias)
        field = field if index == 3 else functional.leaky_relu(field, SLOPE)
    return field


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("shape", [(1, 1, 20, 23), (2, 1, 150, 300)])
def test_it_is_the_plain_stack_and_its_gradients(shape, learns):
    # The larger field has 2 x 4 tiles of unequal sides, whose halos overlap in the gradient.
    weights, biases = make_parameters(learns)
    generator = torch.Generator().manual_seed(1)
    field = torch.randn(shape, generator=generator, dtype=torch.float64, requires_grad=True)
    height, expected = convolution_stack(field, weights, biases, **EXACT), by_autograd(field, weights, biases)
    assert height.shape == (shape[0], 1, shape[2] - 8, shape[3] - 8)
    # The same sums in another order: 54 terms of order one in double precision.
    assert torch.allclose(height, expected, rtol=0, atol=1e-13)
    upstream = torch.randn(height.shape, generator=generator, dtype=torch.float64)
    wanted = [field, *weights, *biases] if learns else [field]
    for ours, plain in zip(
        torch.autograd.grad(height, wanted, upstream),
        torch.autograd.grad(expected, wanted, upstream),
        strict=True,
    ):
        # A weight sums up to 80,000 pixels: relative to the largest, some hundred roundings of 1e-16.
        assert float((ours - plain).abs().max()) < 1e-13 * max(1.0, float(plain.abs().max()))


def test_an_activation_that_the_tiles_do_not_know_runs_layer_by_layer():
    net = AreawiseNet((16, 16), SLOPE)
    field = torch.randn(1, 1, 40, 40, generator=torch.Generator().manual_seed(5))
    tiled = net(field)
    net.activation = nn.GELU()
    expected = field
    for layer in net.hidden:
        expected = functional.gelu(layer(expected))
    assert torch.allclose(net(field), net.last(expected), rtol=0, atol=1e-6)
    assert not torch.allclose(net(field), tiled, atol=1e-3)


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("learns", [False, True])
def test_the_number_of_threads_changes_no_bit(learns, threads):
    weights, biases = make_parameters(learns, torch.float32)
    field = torch.randn(1, 1, 230, 310, generator=torch.Generator().manual_seed(4), requires_grad=True)
    wanted = [field, *weights, *biases] if learns else [field]
    settings = in_dtypes(torch.float32, torch.bfloat16)
    made = []
    for count in (1, 3):
        threads(count)
        height = convolution_stack(field, weights, biases, **settings)
        made.append([height.detach(), *torch.autograd.grad(height.square().sum(), wanted)])
        assert torch.get_num_threads() == count
    assert all(torch.equal(a, b) for a, b in zip(*made, strict=True))


def test_an_error_in_a_tile_is_raised_and_leaves_the_number_of_threads(threads):
    threads(2)
    weights, biases = make_parameters(learns=False)
    weights[1] = weights[1][:, :-1]
    with pytest.raises(RuntimeError, match="channels"):
        convolution_stack(torch.zeros(1, 1, 300, 300, dtype=torch.float64), weights, biases, **EXACT)
    assert torch.get_num_threads() == 2


def test_weights_learn_from_a_field_that_wants_no_gradient():
    weights, biases = make_parameters(learns=True)
    field = torch.randn(1, 1, 30, 30, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    wanted = [*weights, *biases]
    ours = torch.autograd.grad(convolution_stack(field, weights, biases, **EXACT).square().sum(), wanted)
    plain = torch.autograd.grad(by_autograd(field, weights, biases).square().sum(), wanted)
    for a, b in zip(ours, plain, strict=True):
        assert torch.allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("learns", [False, True])
def test_a_reduced_adjoint_leaves_the_height_alone_and_the_gradients_close(learns):
    weights, biases = make_parameters(learns, torch.float32)
    field = torch.randn(1, 1, 200, 200, generator=torch.Generator().manual_seed(2), requires_grad=True)
    wanted = [field, *weights, *biases] if learns else [field]
    heights, gradients = [], []
    for adjoint in (torch.float32, torch.bfloat16):
        settings = in_dtypes(torch.float32, adjoint)
        height = convolution_stack(field, weights, biases, **settings)
        heights.append(height.detach())
        gradients.append(torch.autograd.grad(height.square().sum(), wanted))
    assert torch.equal(*heights)
    # bfloat16 rounds by up to 2^-9 of a value; weights, slopes, features and results of three layers
    # add up to at most 12 such roundings.
    off = [float((reduced - exact).norm() / exact.norm()) for exact, reduced in zip(*gradients, strict=True)]
    assert max(off) < 12 * 2**-9
    # float32 would come 2^15 times closer.
    assert off[0] > 2**-14


def test_without_a_gradient_nothing_is_kept():
    field = torch.zeros(1, 1, 20, 20, dtype=torch.float64)
    assert convolution_stack(field, *make_parameters(learns=False), **EXACT).grad_fn is None


def test_a_frozen_pbl_prints_what_the_trained_one_does(tmp_path):
    torch.manual_seed(0)
    few = {"blurs_um": (0.2,), "slope_blurs_um": (0.1,), "shifts_um": (0.2,), "steep_um": (0.3,)}
    model = build_model("pbl", sigma_diffusion_init_um=0.2, surroundings=few, scan_axis=few)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.03 * torch.randn_like(parameter))
    reach = model.reach_px
    layout = torch.randint(0, 13, (1, 1, 2 * reach + 30, 2 * reach + 40)) * 0.1
    trained = model(layout)
    assert trained.grad_fn is not None
    frozen = load_frozen(save_frozen(model, tmp_path / "pbl"))
    assert torch.allclose(frozen(layout), trained.detach(), atol=1e-6)
    inside = frozen.inside(layout, reach)
    assert inside.shape == (1, 1, 30, 40)
    assert torch.allclose(inside, trained.detach()[..., reach:-reach, reach:-reach], atol=1e-6)
