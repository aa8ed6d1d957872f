"""Compare the light behind reliefs of finite height with rigorous results for gratings and with closed
forms.
"""

from __future__ import annotations

import math

import pytest
import torch

from litho_design.optics import Optics, centred_grid, element_field, intensity_share
from litho_design.optics.thick_element import wave_through_relief
from tests.tensors import assert_close

pytestmark = pytest.mark.numerics

WAVELENGTH_UM, INDEX = 0.6328, 1.548


def first_order(period_um: float, count: int = 128) -> float:
    """Return the share of the light in order +1 behind a blazed grating in resist. The blaze has eight levels
    and a height of one wave.
    """
    steps = torch.arange(count) * 8 // count
    height = (steps.double() * WAVELENGTH_UM / (INDEX - 1) / 8)[None].expand(2, count)
    field = torch.ones(2, count, dtype=torch.complex128)
    wave = wave_through_relief(field, height, period_um / count, WAVELENGTH_UM, INDEX)
    amplitude = torch.fft.fft(wave[0])[1] / count
    return float(amplitude.abs() ** 2) * math.sqrt(1 - (WAVELENGTH_UM / period_um) ** 2)


# These values for the grating are by other code: rigorous coupled waves, TE, normal incidence.
@pytest.mark.parametrize(
    ("period_um", "rigorous", "tolerance"),
    [(12.8, 0.876, 0.01), (6.4, 0.817, 0.01), (3.2, 0.776, 0.01), (1.6, 0.511, 0.05)],
)
def test_a_blaze_comes_close_to_rigorous_coupled_waves(period_um, rigorous, tolerance):
    # A thin element would give 0.950 for all periods.
    assert first_order(period_um) == pytest.approx(rigorous, abs=tolerance)


def test_a_smooth_and_low_relief_is_a_thin_element_but_for_its_reflection():
    x = (torch.arange(96) + 0.5) * 0.1
    height = 0.02 * (1 + torch.cos(2 * math.pi * x.double() / 9.6)).expand(96, 96)
    thick = wave_through_relief(torch.ones(96, 96, dtype=torch.complex128), height, 0.1, WAVELENGTH_UM, INDEX)
    thin = torch.polar(torch.ones_like(height), 2 * math.pi * (INDEX - 1) * height / WAVELENGTH_UM)
    ratio = thick / thin
    # The reflected share is (n - 1)^2 / (n + 1)^2 = 0.0463. Where the surface crosses a slice, two waves with
    # slightly different phases are mixed. A common phase does not matter.
    assert float(ratio.abs().square().mean()) == pytest.approx(1 - 0.0463, abs=2e-3)
    assert (ratio / ratio.mean() - 1).abs().max() < 2e-3


@pytest.mark.parametrize("height_um", [0.0, 0.7])
def test_a_flat_relief_only_reflects(height_um):
    grid = centred_grid((32, 32), 0.1)
    field = element_field(torch.full((32, 32), height_um), grid, Optics(element="thick"))
    # The reflected share is (0.548 / 2.548)^2, and the height of a plate does not change the wave.
    amplitude = math.sqrt(1 - (0.548 / 2.548) ** 2) / 3.2
    assert_close(field, torch.full_like(field, amplitude))


def test_an_element_is_thick_if_its_optics_state_it():
    grid = centred_grid((64, 64), 0.1)
    height = 0.8 * torch.rand(64, 64, generator=torch.Generator().manual_seed(0))
    thin, thick = (element_field(height, grid, Optics(element=kind)) for kind in ("thin", "thick"))
    assert float(intensity_share(thin, grid).sum()) == pytest.approx(1, abs=1e-5)
    # Pixels of 0.1 µm scatter into waves that do not propagate in air. This loses more than reflection.
    assert 0.1 < float(intensity_share(thick, grid).sum()) < 0.9
    assert (thick - thin).abs().max() > 0.1 * thin.abs().max()


def test_gradients_flow_through_the_relief():
    # The tested place is not the highest or at the boundary of a slice, where the derivative jumps.
    height = 0.3 * torch.rand(8, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    height.requires_grad_()
    grid = centred_grid((8, 8), 0.1)

    def power(relief):
        wave = wave_through_relief(
            torch.ones(8, 8, dtype=torch.complex128), relief, 0.1, WAVELENGTH_UM, INDEX
        )
        return intensity_share(wave, grid)[:3].sum()

    (slope,) = torch.autograd.grad(power(height), height)
    moved = torch.zeros(8, 8, dtype=torch.float64)
    moved[3, 4] = 1e-6
    with torch.no_grad():
        change = (power(height + moved) - power(height - moved)) / 2e-6
    # The number and thickness of slices depend on the highest place, which is not changed.
    assert float(change) == pytest.approx(float(slope[3, 4]), rel=1e-3)
