"""Compare the staircase formula with a Fourier transform of the staircase itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from litho_design.optics import Optics, RSPropagator, blaze_efficiency, centred_grid
from litho_design.optics.stroke import measure_stroke

WAVELENGTH_UM = 0.6328


@pytest.mark.parametrize("steps", [2, 4, 8, 12, 13, 16])
@pytest.mark.parametrize("gain", [1.0, 1.039, 0.65])
@pytest.mark.parametrize("order", [0, 1, 2])
def test_formula_equals_the_fourier_coefficient_of_one_period(steps, gain, order):
    # The Fourier coefficient of a piecewise constant period is a sum of integrals in closed form.
    edge = np.arange(steps + 1) / steps
    wave = np.exp(2j * np.pi * gain * np.arange(steps) / steps)
    if order == 0:
        weight = np.diff(edge)
    else:
        primitive = np.exp(-2j * np.pi * order * edge) / (-2j * np.pi * order)
        weight = np.diff(primitive)
    assert blaze_efficiency(steps, gain, order) == pytest.approx(abs((wave * weight).sum()) ** 2, abs=1e-12)


def test_a_grating_of_unequal_steps_has_the_order_of_its_own_heights():
    """Check the orders of measured levels against a discrete Fourier transform of the relief. Two levels
    that differ by half a wave send nothing straight through.
    """
    heights = 1.2 * (np.arange(13) / 12) ** 1.3
    stroke = measure_stroke(heights.tolist(), 1.0, level_height_um=0.1)
    orders = np.abs(np.fft.fft(np.repeat(np.exp(2j * np.pi * heights), 512)) / (13 * 512)) ** 2
    assert [stroke.blaze_order_0, stroke.blaze_order_1] == pytest.approx(orders[:2], abs=1e-6)
    equal = measure_stroke(np.linspace(0, 1.2, 13).tolist(), 1.0, level_height_um=0.1)
    assert equal.blaze_order_1 == pytest.approx(blaze_efficiency(13, 1.2 * 13 / 12))
    assert abs(equal.blaze_order_1 - stroke.blaze_order_1) > 0.03
    assert measure_stroke([0.1, 0.6], 1.0, level_height_um=0.1).blaze_order_0 == pytest.approx(0, abs=1e-12)


def test_published_values():
    values = [blaze_efficiency(n, 1.0) for n in (2, 4, 8, 12, 13, 16)]
    assert values == pytest.approx([0.4053, 0.8106, 0.9496, 0.9774, 0.9807, 0.9872], abs=5e-5)
    assert blaze_efficiency(12, 1.039) == pytest.approx(0.9725, abs=5e-5)
    assert blaze_efficiency(12, 0.65) == pytest.approx(0.644, abs=5e-4)
    assert blaze_efficiency(12, 0.65, 0) == pytest.approx(0.192, abs=5e-4)


def test_orders_of_a_propagated_staircase():
    # The grating has 12 steps of 0.8 µm and is lit by a beam of 15 µm. At 1500 µm, the orders are 99 µm apart
    # and 25 µm wide. A window of 90 µm around an order contains all but 1e-3 of its light and no other order.
    # Its pixels are four of those of the grating, so both fit into one small transform.
    steps, step_px, pitch, gain, z, waist = 12, 4, 0.2, 0.65, 1500.0, 15.0
    period_um = steps * step_px * pitch
    grid = centred_grid((288, 288), pitch)
    radius = np.hypot(grid.y_um[:, None], grid.x_um[None, :])
    level = np.arange(288) // step_px % steps
    beam = torch.from_numpy(np.exp(-((radius / waist) ** 2) + 2j * np.pi * gain * level / steps))
    incident = float(beam.abs().square().sum()) * pitch**2
    for order in (0, 1):
        landing = z * math.tan(math.asin(order * WAVELENGTH_UM / period_um))
        window = centred_grid((112, 112), 0.8, (0.0, landing))
        propagate = RSPropagator(grid, window, z, WAVELENGTH_UM, dtype=torch.complex128)
        share = float(propagate(beam).abs().square().sum()) * 0.8**2 / incident
        # Each step has four samples. Averaging over the flat step reduces the contribution of a sample to the
        # order by this factor.
        sample = np.sinc(order / (steps * step_px)) ** 2
        assert share * sample == pytest.approx(blaze_efficiency(steps, gain, order), abs=1e-3)


def test_the_advised_number_of_steps_completes_one_wave():
    wave_height = Optics().wave_height_um
    assert wave_height == pytest.approx(1.1547, abs=5e-5)
    printed = [0.164 + 0.62 * 0.1 * level for level in range(13)]
    stroke = measure_stroke(printed, wave_height, level_height_um=0.1)
    assert stroke.print_gain == pytest.approx(0.62)
    assert stroke.stroke_waves == pytest.approx(12 * 0.062 / wave_height)
    # At least 19 steps of 0.062 µm are needed to reach 1.1547 µm.
    assert stroke.levels_for_one_wave == 19
    assert 13 * 0.62 * stroke.level_height_for_one_wave_um == pytest.approx(wave_height)
