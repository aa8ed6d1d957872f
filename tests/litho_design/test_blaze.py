"""The staircase formula against a Fourier transform of the staircase itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from litho_design.optics import Optics, blaze_efficiency, centred_grid, stroke_table

WAVELENGTH_UM = 0.6328


@pytest.mark.parametrize("steps", [2, 4, 8, 12, 13, 16])
@pytest.mark.parametrize("gain", [1.0, 1.039, 0.65])
@pytest.mark.parametrize("order", [0, 1, 2])
def test_formula_equals_the_fourier_coefficient_of_one_period(steps, gain, order):
    # Fourier coefficient of a piecewise constant period: every step is integrated in closed form.
    edge = np.arange(steps + 1) / steps
    wave = np.exp(2j * np.pi * gain * np.arange(steps) / steps)
    if order == 0:
        weight = np.diff(edge)
    else:
        primitive = np.exp(-2j * np.pi * order * edge) / (-2j * np.pi * order)
        weight = np.diff(primitive)
    assert blaze_efficiency(steps, gain, order) == pytest.approx(abs((wave * weight).sum()) ** 2, abs=1e-12)


def test_published_values():
    values = [blaze_efficiency(n, 1.0) for n in (2, 4, 8, 12, 13, 16)]
    assert values == pytest.approx([0.4053, 0.8106, 0.9496, 0.9774, 0.9807, 0.9872], abs=5e-5)
    assert blaze_efficiency(12, 1.039) == pytest.approx(0.9725, abs=5e-5)
    assert blaze_efficiency(12, 0.65) == pytest.approx(0.644, abs=5e-4)
    assert blaze_efficiency(12, 0.65, 0) == pytest.approx(0.192, abs=5e-4)


def test_far_order_of_a_propagated_staircase():
    # 12 steps of 0.8 µm, 24 periods; the order is collected around its landing place.
    steps, step_px, pitch, periods = 12, 4, 0.2, 24
    period_um = steps * step_px * pitch
    levels = np.tile(np.repeat(np.arange(steps), step_px), periods)
    wave = torch.from_numpy(np.exp(2j * np.pi * 0.65 * levels / steps))
    grid = centred_grid((1, wave.numel()), pitch)
    x = torch.from_numpy(grid.x_um)
    spectrum = torch.stack([(wave * torch.exp(-2j * np.pi * m * x / period_um)).mean() for m in (0, 1)])
    # Pixels of 0.2 µm sample the period with 48 points: sinc(1/48)^2 = 0.9986 is the pixel's own envelope.
    pixel = np.sinc(1 / (steps * step_px)) ** 2
    assert float(spectrum[0].abs() ** 2) == pytest.approx(blaze_efficiency(steps, 0.65, 0), abs=1e-3)
    assert float(spectrum[1].abs() ** 2) * pixel == pytest.approx(blaze_efficiency(steps, 0.65, 1), abs=1e-3)


def test_advice_closes_the_wave():
    wave_height = Optics().wave_height_um
    assert wave_height == pytest.approx(1.1547, abs=5e-5)
    printed = [0.164 + 0.62 * 0.1 * level for level in range(13)]
    table, advice = stroke_table(printed, wave_height, level_height_um=0.1)
    assert advice["print_gain"] == pytest.approx(0.62)
    assert table["printed_waves"].iloc[-1] == pytest.approx(advice["stroke_waves"])
    # 19 steps of 0.062 µm are the first to reach 1.1547 µm.
    assert advice["levels_for_one_wave"] == 19
    assert 13 * 0.62 * advice["level_height_for_one_wave_um"] == pytest.approx(wave_height)
