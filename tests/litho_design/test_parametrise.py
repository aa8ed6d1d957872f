"""Free parameters, cells and levels."""

from __future__ import annotations

import math

import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design.optimisation.parameters import CellMap, DirectLevels, GumbelLevels
from litho_design.optimisation.phases import nearest_levels
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
    # Odd size: the middle pixel is ring 0, and along an axis the ring number counts pixels.
    assert picture[7, 7:].tolist() == list(range(8))


def test_gumbel_samples_follow_the_softmax():
    parameters = GumbelLevels(LayoutSettings(size_px=200, cell_um=0.1, levels=4))
    logits = torch.tensor([0.0, 1.0, -0.5, 0.3])
    with torch.no_grad():
        parameters.logits.copy_(logits[:, None, None].expand_as(parameters.logits))
    sample = parameters.sample(0.7, hard=True, seed=5)
    share = torch.stack([(sample == level).double().mean() for level in range(4)])
    # Gumbel-max: hard samples are exact draws from softmax(logits); 40000 draws, 4 sigma = 0.01.
    assert (share - logits.softmax(0)).abs().max() < 0.01


def test_samples_repeat_with_their_seed_and_leave_the_global_generator_alone():
    parameters = GumbelLevels(SQUARE)
    state = torch.random.get_rng_state()
    first = parameters.sample(0.5, hard=False, seed=3)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert torch.equal(first, parameters.sample(0.5, hard=False, seed=3))
    assert not torch.equal(first, parameters.sample(0.5, hard=False, seed=4))


@pytest.mark.parametrize("kind", [GumbelLevels, DirectLevels])
def test_hard_samples_are_levels_and_pass_a_gradient(kind):
    parameters = kind(SQUARE)
    parameters.start_random(0)
    sample = parameters.sample(0.5, hard=True, seed=0)
    # Straight-through adds and removes the soft part; what is left of it is rounding.
    assert (sample - sample.round()).abs().max() < 1e-5
    (sample * torch.arange(16.0)).sum().backward()
    gradient = next(parameters.parameters()).grad
    assert torch.isfinite(gradient).all()
    assert gradient.abs().max() > 0


def test_straight_through_gradient_is_that_of_the_unrounded_height():
    parameters = DirectLevels(SQUARE)
    parameters.start_random(0)
    weight = torch.randn(16, 16)
    (parameters.sample(1.0, hard=True, seed=0) * weight).sum().backward()
    expected = weight.unflatten(1, (4, 4)).unflatten(0, (4, 4)).sum((1, 3))
    assert torch.allclose(parameters.height.grad, expected, atol=1e-5)


@pytest.mark.parametrize("kind", [GumbelLevels, DirectLevels])
def test_a_start_is_its_own_best_layout(kind):
    parameters = kind(SQUARE)
    levels = torch.randint(0, 5, (4, 4))
    parameters.start_from(levels.float())
    assert torch.equal(parameters.best_levels(), levels)


def test_heights_that_left_the_range_come_back():
    parameters = DirectLevels(SQUARE)
    parameters.start_from(torch.full((4, 4), 7.5))
    parameters.project()
    assert (parameters.best_levels() == 4).all()


def test_nearest_level_on_the_circle():
    printed = torch.tensor([0.1, 1.0, 2.0])
    # 6.2 rad is 0.18 rad below 0.1 on the circle; 4.0 is 2.0 from 2.0 and 2.38 from 0.1.
    assert nearest_levels(torch.tensor([6.2, 0.9, 4.0, -0.1]), printed).tolist() == [0, 1, 2, 0]


def test_cells_must_fill_the_element():
    with pytest.raises(InputError, match="cell_um"):
        CellMap(LayoutSettings(size_px=10, cell_um=0.4))
    with pytest.raises(InputError, match="cell_um"):
        CellMap(LayoutSettings(size_px=16, cell_um=0.25))
