"""Slopes, developed area, texture and filters against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ellipe

from litho_data.foundation.errors import InputError
from litho_data.roughness import areal_parameters, decay_lengths_um, high_pass, low_pass

PITCH_UM = (0.05, 0.08)


def wave(shape: tuple[int, int], length_um: float, amplitude_um: float) -> np.ndarray:
    x = (np.arange(shape[1]) + 0.5) * PITCH_UM[1]
    return np.broadcast_to(amplitude_um * np.sin(2 * np.pi * x / length_um), shape).copy()


@pytest.mark.parametrize("amplitude_um", [0.01, 0.5])
def test_slopes_and_area_of_a_sine_are_the_closed_forms(amplitude_um: float) -> None:
    # 400 columns are 32 µm, and the 394 that count about 10 periods of 3.2 µm: two parts in a hundred.
    length_um = 3.2
    found = areal_parameters(wave((40, 406), length_um, amplitude_um), PITCH_UM)
    steepest = 2 * np.pi * amplitude_um / length_um
    # The seven-pixel slope of 40 pixels per period is exact to 2π/40 to the sixth power over 140: 1e-7.
    assert found.sdq == pytest.approx(steepest / np.sqrt(2), rel=1e-6)
    square = steepest**2
    area = 2 / np.pi * np.sqrt(1 + square) * ellipe(square / (1 + square))
    assert found.sdr == pytest.approx(area - 1, rel=1e-5)


def test_a_tilted_plane_has_its_slope_and_its_area() -> None:
    y, x = np.mgrid[:20, :30]
    rng = np.random.default_rng(0)
    plane = 0.3 * x * PITCH_UM[1] - 0.4 * y * PITCH_UM[0] + 1e-9 * rng.standard_normal((20, 30))
    found = areal_parameters(plane, PITCH_UM)
    assert found.sdq == pytest.approx(0.5, rel=1e-6)
    assert found.sdr == pytest.approx(np.sqrt(1.25) - 1, rel=1e-6)
    assert found.pixels == 14 * 24


@pytest.mark.parametrize("ratio", [1.0, 2.5])
@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0])
def test_texture_of_a_gaussian_correlation_is_its_axes(ratio: float, angle_deg: float) -> None:
    """exp(−(u/a)² − (v/b)²) falls to 0.2 at a √ln 5 and b √ln 5."""
    y, x = np.mgrid[0:120, -100:101].astype(float)
    x, y = x * PITCH_UM[1], y * PITCH_UM[0]
    angle = np.radians(angle_deg)
    u, v = x * np.cos(angle) + y * np.sin(angle), -x * np.sin(angle) + y * np.cos(angle)
    short_um = 0.8
    correlation = np.exp(-((u / short_um) ** 2) - (v / (ratio * short_um)) ** 2)
    shortest, longest = decay_lengths_um(correlation, PITCH_UM)
    # A cubic spline over 10 pixels per length, and directions one degree apart.
    assert shortest == pytest.approx(short_um * np.sqrt(np.log(5)), rel=1e-3)
    assert longest == pytest.approx(ratio * short_um * np.sqrt(np.log(5)), rel=1e-3)


def test_a_grating_has_one_direction() -> None:
    found = areal_parameters(wave((80, 400), 3.2, 0.1), PITCH_UM)
    assert found.str_ratio == 0
    # Its correlation is cos(2π x / λ); cut off after L, it has an error of λ / 4πL = 0.8 %.
    assert found.sal_um == pytest.approx(3.2 * np.arccos(0.2) / (2 * np.pi), rel=0.02)


@pytest.mark.parametrize("length_um", [0.8, 1.6, 3.2])
def test_half_of_an_amplitude_passes_at_the_cut_off(length_um: float) -> None:
    cut_off_um = 1.6
    surface = wave((12, 1200), length_um, 0.1)
    inner = (slice(None), slice(200, -200))
    passed = low_pass(surface, PITCH_UM, cut_off_um)
    share = 0.5 ** ((cut_off_um / length_um) ** 2)
    np.testing.assert_allclose(passed[inner], share * surface[inner], atol=1e-6)
    rest = high_pass(surface, PITCH_UM, cut_off_um)
    np.testing.assert_allclose(rest[inner], (1 - share) * surface[inner], atol=1e-6)


def test_filters_leave_a_constant_and_gaps_alone() -> None:
    surface = np.full((30, 40), 0.7)
    surface[5:9, 3:20] = np.nan
    passed = low_pass(surface, PITCH_UM, 0.9)
    np.testing.assert_array_equal(np.isnan(passed), np.isnan(surface))
    np.testing.assert_allclose(passed[np.isfinite(passed)], 0.7, rtol=1e-12)


@pytest.mark.parametrize(
    ("surface", "pitch_um"),
    [(np.full((9, 9), np.nan), (1, 1)), (np.eye(5), (1, 1)), (np.eye(9), (0, 1)), (np.ones((9, 9)), (1, 1))],
)
def test_what_has_no_texture_is_refused(surface: np.ndarray, pitch_um: tuple[float, float]) -> None:
    with pytest.raises(InputError):
        areal_parameters(surface, pitch_um)
