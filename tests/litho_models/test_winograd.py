"""Fixed convolutions with fewer multiplications are the convolutions they stand for."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torch.autograd.function import FunctionCtx
from torch.nn import functional

from litho_models.fast import convolution_stack, winograd
from litho_models.fast.winograd import FixedStack
from litho_models.fast.winograd_passes import FRAME_PX, lift_back

pytestmark = pytest.mark.numerics

SLOPE = 0.02


def make_parameters(*channels: int) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    generator = torch.Generator().manual_seed(0)
    widths = (1, *channels, 1)
    weights = [torch.randn(b, a, 3, 3, generator=generator) / (9 * a) ** 0.5 for a, b in pairwise(widths)]
    return weights, [0.3 * torch.randn(width, generator=generator) for width in widths[1:]]


@pytest.fixture(scope="module")
def parameters():
    return make_parameters(32, 16, 48)


def make_stack(parameters) -> FixedStack:
    return FixedStack(*parameters, SLOPE, tile_px=128)


def random_field(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def exact(
    tile: torch.Tensor, parameters, signs: list[torch.Tensor], upstream: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Result without the last bias, and gradient to the tile, by plain convolutions in float64.

    The leaky ReLU goes by ``signs``: beside a value of 1e-7 rounding decides on which side it stands.
    """
    tile = tile.double().requires_grad_()
    features = tile[None, None]
    (*weights, last), biases = parameters
    for weight, bias, sign in zip(weights, biases, signs, strict=False):
        features = functional.conv2d(features, weight.double(), bias.double())
        ny, nx = features.shape[-2:]
        features = features * torch.where(sign[..., :ny, :nx] > 0, 1.0, SLOPE)
    heights = functional.conv2d(features, last.double())[0, 0]
    (gradient,) = torch.autograd.grad(heights, tile, upstream.double())
    return heights.detach(), gradient


@pytest.mark.parametrize("channels", [(16,), (32, 16, 48), (16, 32, 16, 16, 16)])
@pytest.mark.parametrize("shape", [(1, 1), (4, 4), (5, 6), (7, 3), (64, 81), (128, 127)])
def test_heights_and_gradient_are_those_of_plain_convolutions(shape, channels):
    # Sides of all four remainders, one patch and many blocks of them; no hidden weights and many.
    parameters = make_parameters(*channels)
    stack = make_stack(parameters)
    halo = 2 * len(parameters[0])
    tile, upstream = random_field(*(side + halo for side in shape)), random_field(*shape, seed=2)
    heights, signs = stack.heights(tile)
    gradient = stack.adjoint(upstream, signs)
    expected, expected_gradient = exact(tile, parameters, signs, upstream)
    assert heights.shape == shape
    assert gradient.shape == tile.shape
    # The transforms hold coefficients up to 8 and cancel them again: some ten times the 1e-7 of float32 in
    # each layer. A wrong coefficient shows in the first digit.
    assert float((heights - expected).abs().max()) < 1e-5 * max(1.0, float(expected.abs().max()))
    assert float((gradient - expected_gradient).norm()) < 1e-5 * float(expected_gradient.norm())


def test_a_kernel_of_one_tap_moves_the_field(parameters):
    weights = [torch.zeros_like(weight) for weight in parameters[0]]
    for number, weight in enumerate(weights):
        weight[0, 0, number % 3, 2 - number % 3] = 1
    tile = random_field(30, 30).abs()
    heights, _ = make_stack((weights, [torch.zeros_like(bias) for bias in parameters[1]])).heights(tile)
    y, x = (sum(taps) for taps in ((0, 1, 2, 0), (2, 1, 0, 2)))
    assert torch.allclose(heights, tile[y : y + 22, x : x + 22], atol=1e-5)


def test_a_value_that_is_not_a_number_stays_one_and_goes_no_farther_than_its_patches(parameters):
    stack, tile = make_stack(parameters), random_field(100, 100)
    clean, _ = stack.heights(tile)
    tile[50, 50] = torch.nan
    spoilt, _ = stack.heights(tile)
    assert torch.isnan(spoilt[46, 46])
    # In the first and the last layer it reaches 2 px towards the origin, in the two between as many, and
    # with the patch 3 more on both sides.
    near = slice(50 - 4 * 2 - 2 * 3, 50 + 2 * 3 + 1)
    assert torch.isfinite(spoilt).any()
    spoilt[near, near] = clean[near, near]
    assert torch.equal(spoilt, clean)


def test_nothing_of_a_tile_is_left_for_the_next(parameters):
    used = make_stack(parameters)
    _, signs = used.heights(torch.full((136, 136), torch.nan))
    used.adjoint(torch.full((128, 128), torch.nan), signs)
    for side in (90, 31, 10):
        tile, upstream = random_field(side, side + 1), random_field(side - 8, side - 7, seed=2)
        made = []
        for stack in (used, make_stack(parameters)):
            heights, signs = stack.heights(tile)
            made.append((heights, stack.adjoint(upstream, signs)))
        assert all(torch.equal(ours, fresh) for ours, fresh in zip(*made, strict=True))


def test_biases_may_be_views_and_what_does_not_fit_is_said(parameters):
    weights, biases = parameters
    tile = random_field(20, 20)
    expected, _ = make_stack(parameters).heights(tile)
    views = [torch.stack([bias, bias + 1], dim=1)[:, 0] for bias in biases]
    assert torch.equal(make_stack((weights, views)).heights(tile)[0], expected)
    wrong = {
        "do not fit": ([*weights[:1], weights[1][:, :16], *weights[2:]], biases),
        "not multiples": make_parameters(16, 20),
        "not float32": (weights, [bias.double() for bias in biases]),
    }
    for reason, layers in wrong.items():
        with pytest.raises(ValueError, match=reason):
            make_stack(layers)


def test_signs_are_those_of_the_hidden_values(parameters):
    weights, biases = parameters
    tile = random_field(20, 21)
    _, signs = make_stack(parameters).heights(tile)
    features = tile[None, None]
    for weight, bias, sign in zip(weights, biases, signs, strict=False):
        features = functional.conv2d(features, weight, bias)
        ny, nx = features.shape[-2:]
        clear = features.abs() > 1e-4
        assert torch.equal((sign[..., :ny, :nx] > 0)[clear], (features > 0)[clear])
        features = functional.leaky_relu(features, SLOPE)


def test_the_frame_of_an_adjoint_stays_zero():
    framed = np.zeros((9 + 2 * FRAME_PX, 8 + 2 * FRAME_PX, 16), np.float32)
    signs = np.where(np.arange(9 * 8 * 16).reshape(9, 8, 16) % 2, 1, -1).astype(np.int8)
    taps = np.zeros((9, 16), np.float32)
    taps[4] = np.arange(16)
    image = random_field(11, 10).numpy()
    lift_back(image, taps, np.float32(SLOPE), signs, framed)
    inside = framed[FRAME_PX:-FRAME_PX, FRAME_PX:-FRAME_PX]
    expected = image[1:-1, 1:-1, None] * taps[4] * np.where(signs > 0, np.float32(1), np.float32(SLOPE))
    assert np.allclose(inside, expected, rtol=1e-6, atol=0)
    inside[:] = 0
    assert not framed.any()


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("adjoint", [torch.float32, torch.bfloat16])
def test_it_is_what_a_fixed_stack_runs_with_any_number_of_threads(adjoint, parameters, threads, monkeypatch):
    uses = []
    heights = FixedStack.heights
    monkeypatch.setattr(FixedStack, "heights", lambda self, tile: uses.append(1) or heights(self, tile))
    field = random_field(2, 1, 150, 310).requires_grad_()
    settings = _in(torch.float32, adjoint)
    made = []
    # Two fields of 2 x 3 tiles: more of them than threads, and fewer.
    for count in (1, 3, 16):
        threads(count)
        height = convolution_stack(field, *parameters, **settings)
        made.append([height.detach()])
        for _ in range(2):
            made[-1] += torch.autograd.grad(height.square().sum(), field, retain_graph=True)
    assert len(uses) == 3 * 12
    for others in made[1:]:
        assert all(torch.equal(a, b) for a, b in zip(made[0], others, strict=True))
    assert torch.equal(made[0][1], made[0][2])
    by_convolutions = convolution_stack(field.double(), *_double(parameters), **_in(torch.float64))
    assert torch.allclose(made[0][0].double(), by_convolutions, atol=1e-5)
    (expected,) = torch.autograd.grad(by_convolutions.square().sum(), field)
    # Some of 10 million hidden values are within 1e-6 of zero and pass another slope there. bfloat16 rounds
    # by up to 2^-9 of a value, at most 12 times one after the other.
    tolerance = 1e-2 if adjoint == torch.float32 else 12 * 2**-9
    assert float((made[0][1] - expected).norm() / expected.norm()) < tolerance


@pytest.mark.parametrize("without", [torch.no_grad, torch.inference_mode])
def test_without_a_graph_any_number_of_threads_predicts_and_nothing_is_kept(
    without, parameters, threads, monkeypatch
):
    kept = []
    save = FunctionCtx.save_for_backward

    def count(ctx, *tensors):
        kept.append(len(tensors))
        save(ctx, *tensors)

    monkeypatch.setattr(FunctionCtx, "save_for_backward", count)
    field = random_field(1, 1, 300, 300).requires_grad_()
    expected = convolution_stack(field, *parameters, **_in(torch.float32)).detach()
    threads(3)
    with without():
        assert torch.equal(convolution_stack(field, *parameters, **_in(torch.float32)), expected)
    # The field, four weights, four biases; with a graph the signs of 3 x 3 tiles in three layers too.
    assert kept == [9 + 27, 9]


def test_weights_that_learn_and_odd_numbers_of_channels_are_convolved(parameters, monkeypatch):
    monkeypatch.setattr(winograd, "FixedStack", None)
    settings = _in(torch.float32)
    field = random_field(1, 1, 20, 20)
    learning = [[p.clone().requires_grad_() for p in half] for half in parameters]
    height = convolution_stack(field, *learning, **settings)
    assert height.requires_grad
    with torch.no_grad():
        assert torch.equal(convolution_stack(field, *learning, **settings), height)
    narrow = make_parameters(7, 16)
    assert convolution_stack(field, *narrow, **settings).shape == (1, 1, 14, 14)


def _double(parameters) -> list[list[torch.Tensor]]:
    return [[tensor.double() for tensor in half] for half in parameters]


def _in(dtype: torch.dtype, adjoint: torch.dtype | None = None) -> dict[str, Any]:
    return {"leaky_slope": SLOPE, "hidden_dtype": dtype, "adjoint_dtype": adjoint or dtype}
