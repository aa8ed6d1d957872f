"""Check that the direction and period of lines on a surface are found if, and only if, there are lines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from litho_data.foundation.errors import InputError
from litho_data.roughness import line_direction, line_period

PITCH_UM = 0.1


def rough(seed: int, size_px: int = 192) -> np.ndarray:
    """Return isotropic roughness with some white noise, as in scans."""
    random = np.random.default_rng(seed)
    white = random.normal(size=(2, size_px, size_px))
    return gaussian_filter(white[0], 2.0, mode="wrap") + 0.03 * white[1]


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, -45.0])
def test_the_direction_of_lines_is_found(angle_deg: float) -> None:
    y, x = np.mgrid[:192, :192] - 96.0
    across = -np.sin(np.radians(angle_deg)) * x + np.cos(np.radians(angle_deg)) * y
    line = gaussian_filter(np.random.default_rng(1).normal(size=400), 3.0)
    found = line_direction([np.interp(across + 200, np.arange(400), line)])
    # Lines that are 192 px long resolve angles of 1 / 192 rad = 0.3°.
    assert (found.angle_deg - angle_deg + 90) % 180 - 90 == pytest.approx(0.0, abs=0.3)
    assert found.strength > 0.9
    assert found.p < 0.01


def test_lines_that_are_weak_in_one_surface_stand_out_in_ten() -> None:
    lines = 0.1 * np.random.default_rng(2).normal(size=(10, 192, 1))
    found = line_direction([rough(seed) + own for seed, own in enumerate(lines)])
    assert found.p < 1e-6
    assert abs(found.angle_deg) < 5
    turned = line_direction([(rough(seed) + own).T for seed, own in enumerate(lines)])
    assert abs(abs(turned.angle_deg) - 90) < 5


def test_stated_probabilities_are_right() -> None:
    count = 200
    direction = np.array([line_direction([rough(seed, 96)]).p for seed in range(count)])
    period = []
    for seed in range(count):
        found = line_period([rough(seed, 128).mean(axis=1)], PITCH_UM)
        assert found is not None
        period.append(found.p)
    # By chance, 10 ± 3 of 200 draws are below 5 %. The limit allows four standard deviations.
    assert (direction < 0.05).sum() <= 22
    assert (np.array(period) < 0.05).sum() <= 22


def test_a_period_is_found_with_its_amplitude_and_phase() -> None:
    """Check a weak wave with a period of 1.3 µm. Its phase is the same in all surfaces, or random in each
    surface.
    """
    random = np.random.default_rng(3)
    at = np.arange(256)
    noise = gaussian_filter(random.normal(size=(12, 256)), (0, 1.0)) * 0.01

    def with_wave(phases: np.ndarray) -> list[np.ndarray]:
        return list(noise + 0.004 * np.cos(2 * np.pi * at / 13 + phases[:, None]))

    locked = line_period(with_wave(np.zeros(12)), PITCH_UM)
    free = line_period(with_wave(random.uniform(0, 2 * np.pi, 12)), PITCH_UM)
    assert locked is not None
    assert free is not None
    for found in (locked, free):
        assert found.p < 1e-4
        # At this period, the frequency bin of a 25.6 µm profile is 1.3² / 25.6 = 0.07 µm wide.
        assert found.period_um == pytest.approx(1.3, abs=0.03)
        # The noise at this frequency is less than a third of the amplitude, and adds in quadrature.
        assert found.amplitude_um == pytest.approx(0.004, rel=0.15)
    assert locked.coherence > 0.9
    # The mean of twelve random phasors has an rms of 1 / √12 = 0.29. It exceeds 0.7 in
    # exp(-12 · 0.49) = 0.3 % of draws.
    assert free.coherence < 0.7


def test_few_lines_have_no_period_and_small_surfaces_no_direction() -> None:
    assert line_period([np.zeros(63)], PITCH_UM) is None
    with pytest.raises(InputError, match="at least 64"):
        line_direction([np.zeros((63, 100))])


def test_flat_surfaces_have_neither_period_nor_direction() -> None:
    assert line_direction([np.zeros((64, 64))]).p == 1.0
    found = line_period([np.zeros(128)], PITCH_UM)
    assert found is None or found.p > 0.5
