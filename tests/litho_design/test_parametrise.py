"""Test free parameters, cells and levels."""

from __future__ import annotations

import math

import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design.optimisation.parameters import CellMap, DirectLevels, GumbelLevels, make_parametrisation
from litho_design.optimisation.phases import nearest_levels
from litho_design.optimisation.settings import SearchSettings
from litho_design.printers.layout import LayoutSettings

SQUARE = LayoutSettings(size_px=16, cell_um=0.4, levels=5)
RINGS = LayoutSettings(size_px=15, cell_um=0.1, levels=5, symmetry="radial")


@pytest.mark.parametrize("layout", [SQUARE, RINGS])
def test_average_undoes_the_spread(layout):
    cells = CellMap(layout)
    values = torch.arange(math.prod(cells.cells), dtype=torch.float64).reshape(cells.cells)
    assert torch.allclose(cells.average(cells(values)), values)


def test_rings_are_symmetric_and_a_pixel_wide():
    cells = CellMap(RINGS)
    picture = cells(torch.arange(cells.cells[0]))
    for same in (picture.T, picture.flip(0), picture.flip(1)):
        assert torch.equal(picture, same)
    # For an odd size, the middle pixel is ring 0, and along an axis each pixel is a further ring.
    assert picture[7, 7:].tolist() == list(range(8))


def test_gumbel_samples_follow_the_softmax():
    parameters = GumbelLevels(LayoutSettings(size_px=200, cell_um=0.1, levels=4))
    logits = torch.tensor([0.0, 1.0, -0.5, 0.3])
    with torch.no_grad():
        parameters.logits.copy_(logits[:, None, None].expand_as(parameters.logits))
    sample = parameters.sample(0.001, seed=5).round()
    share = torch.stack([(sample == level).double().mean() for level in range(4)])
    # By the Gumbel-max trick, samples at low temperature are exact draws from softmax(logits). For 40000
    # draws, four sigma are 0.01.
    assert (share - logits.softmax(0)).abs().max() < 0.01


def test_samples_repeat_with_their_seed_and_leave_the_global_generator_alone():
    parameters = GumbelLevels(SQUARE)
    state = torch.random.get_rng_state()
    first = parameters.sample(0.5, seed=3)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert torch.equal(first, parameters.sample(0.5, seed=3))
    assert not torch.equal(first, parameters.sample(0.5, seed=4))


def test_straight_through_gradient_is_that_of_the_unrounded_height():
    parameters = DirectLevels(SQUARE)
    parameters.start_random(0)
    weight = torch.randn(16, 16)
    sample = parameters.sample(hard=True)
    # The straight-through estimator adds and subtracts the real value, so a rounding error remains.
    assert (sample - sample.round()).abs().max() < 1e-5
    (sample * weight).sum().backward()
    expected = weight.unflatten(1, (4, 4)).unflatten(0, (4, 4)).sum((1, 3))
    assert torch.allclose(parameters.height.grad, expected, atol=1e-5)


@pytest.mark.parametrize("kind", [GumbelLevels, DirectLevels])
def test_the_best_layout_of_a_start_is_the_start(kind):
    parameters = kind(SQUARE)
    levels = torch.randint(0, 5, (4, 4))
    parameters.start_from(levels.float())
    assert torch.equal(parameters.best_levels(), levels)


def test_heights_outside_the_range_return_to_it():
    parameters = DirectLevels(SQUARE)
    parameters.start_from(torch.full((4, 4), 7.5))
    parameters.project()
    assert (parameters.best_levels() == 4).all()


def test_nearest_level_on_the_circle():
    printed = torch.tensor([0.1, 1.0, 2.0])
    # On the circle, 6.2 rad is 0.18 rad below 0.1, and 4.0 is 2.0 from 2.0 and 2.38 from 0.1.
    assert nearest_levels(torch.tensor([6.2, 0.9, 4.0, -0.1]), printed).tolist() == [0, 1, 2, 0]


def test_cells_must_fill_the_element():
    with pytest.raises(InputError, match="cell_um"):
        CellMap(LayoutSettings(size_px=10, cell_um=0.4))
    with pytest.raises(InputError, match="cell_um"):
        CellMap(LayoutSettings(size_px=16, cell_um=0.25))


@pytest.mark.parametrize("layout", [SQUARE.model_copy(update={"size_px": 44}), RINGS])
def test_a_filter_over_the_cells_is_gaussian_in_the_levels_and_in_their_gradient(layout):
    """Check that the kernel describes both how one free cell changes its neighbours and how it receives their
    gradients.
    """
    filtered = layout.model_copy(update={"cell_filter_um": 0.8 * layout.cell_um})
    parameters = DirectLevels(filtered)
    middle = tuple(side // 2 for side in parameters.cells.cells)
    with torch.no_grad():
        parameters.height[middle] = 4.0
    level = parameters.cells.average(parameters.sample(0.5, seed=0)[0, 0])
    kernel = torch.exp(-((torch.arange(-4, 5) / 0.8) ** 2) / 2)
    kernel = kernel / kernel.sum()
    wanted = 4 * (kernel if level.dim() == 1 else kernel[:, None] * kernel)
    around = tuple(slice(one - 4, one + 5) for one in middle)
    # The kernel is truncated at four sigma, which removes 6e-5 of the Gaussian.
    assert torch.allclose(level[around], wanted, atol=1e-3)
    sample = parameters.sample(hard=True)
    assert torch.equal(sample, sample.round())
    assert sample.min() >= 0
    assert sample.max() <= 4
    (gradient,) = torch.autograd.grad(sample[0, 0].sum(), parameters.height)
    # Every pixel counts once, and a filter with a sum of 1 keeps the whole gradient.
    assert float(gradient.sum()) == pytest.approx(sample.numel(), rel=1e-5)
    assert torch.equal(DirectLevels(layout)._kept(), DirectLevels(layout).height)


def test_a_filter_needs_neighbours():
    layout = SQUARE.model_copy(update={"cell_filter_um": 0.4})
    with pytest.raises(InputError, match="cannot be filtered"):
        make_parametrisation(layout, SearchSettings(parametrisation="gumbel"))
