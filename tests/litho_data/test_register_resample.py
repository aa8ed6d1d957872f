"""Check that resampling agrees with an analytic field, and marks gaps and edges as invalid."""

from __future__ import annotations

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_data.register import apply_transform, resample_to_layout, smooth_measured
from litho_data.register.resample import noise_variance_factor
from litho_data.register.topography import fill_gaps

SCAN_SHAPE, LAYOUT_SHAPE = (120, 150), (100, 110)
SCAN_PITCH_UM, LAYOUT_PITCH_UM = (0.1, 0.09), 0.1


def field_um(x_um: np.ndarray, y_um: np.ndarray) -> np.ndarray:
    """Return a field with periods of 2 µm along x (18 pixels) and 1.6 µm along y (16 pixels)."""
    return 0.4 * np.sin(2 * np.pi * x_um / 2.0 + 0.3) * np.cos(2 * np.pi * y_um / 1.6) + 0.01 * x_um


def grid_um(shape: tuple[int, int], pitch_um: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    y, x = (np.arange(n) + 0.5 for n in shape)
    return np.meshgrid(x * pitch_um[1], y * pitch_um[0])


def similarity(angle_deg: float, scale: float, shift_um: tuple[float, float]) -> np.ndarray:
    angle = np.radians(angle_deg)
    matrix = np.eye(3)
    matrix[:2, :2] = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix[:2, 2] = shift_um
    return matrix


def resample(height_um, scan_to_layout, shape=LAYOUT_SHAPE):
    return resample_to_layout(
        height_um, scan_to_layout, shape, scan_pitch_um=SCAN_PITCH_UM, layout_pitch_um=LAYOUT_PITCH_UM
    )


@pytest.mark.parametrize("flip", [False, True])
def test_a_band_limited_field_comes_out_as_its_formula(flip):
    transform = similarity(2.0, 1.02, (-0.6, 0.7)) @ np.diag([1.0, -1.0 if flip else 1.0, 1.0])
    transform[1, 2] += 11.0 if flip else -0.7
    height, valid = resample(field_um(*grid_um(SCAN_SHAPE, SCAN_PITCH_UM)), transform)
    x, y = grid_um(LAYOUT_SHAPE, (LAYOUT_PITCH_UM, LAYOUT_PITCH_UM))
    on_scan = apply_transform(np.linalg.inv(transform), np.stack([x.ravel(), y.ravel()], axis=1))
    expected = field_um(*on_scan.T).reshape(LAYOUT_SHAPE)
    assert height.dtype == np.float32
    # The effect of the spline's boundary decays by 0.268 per pixel. A border of six pixels is excluded.
    inner = np.zeros(LAYOUT_SHAPE, bool)
    near = 6 * np.array(SCAN_PITCH_UM[::-1])
    size = np.array([SCAN_SHAPE[1] * SCAN_PITCH_UM[1], SCAN_SHAPE[0] * SCAN_PITCH_UM[0]])
    inner.ravel()[:] = ((on_scan > near) & (on_scan < size - near)).all(axis=1)
    assert (inner & valid).sum() > 0.5 * inner.size
    # At k = 2π/16 per pixel, the relative error of a cubic spline is about k⁴/ 180 / 4 ≈ 1e-4.
    np.testing.assert_allclose(height[inner & valid], expected[inner & valid], atol=1e-4)


def test_the_identity_on_the_same_grid_changes_nothing():
    height = np.random.default_rng(0).standard_normal((40, 50))
    out, valid = resample_to_layout(
        height, np.eye(3), (40, 50), scan_pitch_um=(0.1, 0.1), layout_pitch_um=0.1
    )
    assert valid.all()
    np.testing.assert_allclose(out, height, atol=1e-6)  # float32 rounding at values of order one


def test_two_transforms_compose_in_micrometres():
    first, second = similarity(1.0, 0.99, (0.4, -0.2)), similarity(-2.0, 1.01, (-0.3, 0.5))
    points = np.array([[0.0, 0.0], [5.1, 7.7], [12.0, 3.0]])
    np.testing.assert_allclose(
        apply_transform(second, apply_transform(first, points)),
        apply_transform(second @ first, points),
        atol=1e-12,
    )
    scan = field_um(*grid_um(SCAN_SHAPE, SCAN_PITCH_UM))
    once, _ = resample(scan, second @ first)
    middle, _ = resample(scan, first, (140, 150))
    twice, _ = resample_to_layout(
        middle, second, LAYOUT_SHAPE, scan_pitch_um=(0.1, 0.1), layout_pitch_um=LAYOUT_PITCH_UM
    )
    both = np.isfinite(once) & np.isfinite(twice)
    both[:20], both[-20:], both[:, :20], both[:, -20:] = False, False, False, False
    # Each interpolation has an error of 1e-4 µm.
    np.testing.assert_allclose(once[both], twice[both], atol=3e-4)


def test_outside_the_scan_nothing_is_valid_and_heights_are_nan():
    scan = np.ones((50, 60))
    shift = np.eye(3)
    shift[0, 2] = 2.0  # twenty pixels to the right
    height, valid = resample_to_layout(scan, shift, (50, 60), scan_pitch_um=(0.1, 0.1), layout_pitch_um=0.1)
    assert not valid[:, :20].any()
    assert valid[:, 20:].all()
    np.testing.assert_array_equal(np.isnan(height), ~valid)


def test_a_gap_invalidates_the_pixels_of_its_kernel_and_no_others():
    x, y = grid_um((80, 90), (0.1, 0.1))
    scan = field_um(x, y)
    scan[30, 40] = np.nan
    scan[60:, 70:] = np.nan
    shift = np.eye(3)
    shift[:2, 2] = 0.025
    height, valid = resample_to_layout(scan, shift, (80, 90), scan_pitch_um=(0.1, 0.1), layout_pitch_um=0.1)
    assert not valid[29:32, 39:42].any()
    assert not valid[60:, 70:].any()
    assert valid[20:27, 30:37].all()
    expected = field_um(x - 0.025, y - 0.025)
    far = valid.copy()
    far[:6], far[-6:], far[:, :6], far[:, -6:] = False, False, False, False
    # One pixel into the gap, a linear extrapolation is wrong by at most k² · 0.4 µm = 0.06 µm (k = 2π/16).
    # The cardinal spline carries about 3 % of this error two pixels away.
    assert np.abs(height - expected)[far].max() < 2e-3
    far[52:, 62:] = False
    far[22:39, 32:49] = False
    np.testing.assert_allclose(height[far], expected[far], atol=1e-4)


def test_resampled_white_noise_has_the_recorded_share_of_its_variance():
    noise = np.random.default_rng(1).standard_normal((600, 600))
    rotation = similarity(3.0, 1.0, (0.0, 0.0))
    out, valid = resample_to_layout(
        noise, rotation, (600, 600), scan_pitch_um=(0.1, 0.1), layout_pitch_um=0.1
    )
    # From 3e5 pixels with slightly correlated neighbours, the variance is known to about 0.4 %.
    assert out[valid].var() == pytest.approx(noise_variance_factor((0.1, 0.1), 0.1), rel=0.015)


def test_a_finely_sampled_scan_is_averaged_not_aliased():
    fine = np.random.default_rng(2).standard_normal((1200, 1200))
    out, valid = resample_to_layout(
        fine, np.eye(3), (150, 150), scan_pitch_um=(0.0125, 0.0125), layout_pitch_um=0.1
    )
    # A Gaussian of the box's variance, sigma² = 63 / 12, averages over 4 π sigma² = 66 pixels.
    assert noise_variance_factor((0.0125, 0.0125), 0.1) == pytest.approx(1 / 66, rel=0.01)
    # From 22500 pixels, whose neighbours correlate by 5 %, the variance is known to about 1 %.
    assert out[valid].var() == pytest.approx(1 / 66, rel=0.04)


def test_smoothing_across_gaps_is_unbiased_on_a_constant_and_keeps_weights_one():
    height = np.full((40, 40), 0.7)
    height[np.random.default_rng(3).random((40, 40)) < 0.3] = np.nan
    np.testing.assert_allclose(smooth_measured(height, 1.0), 0.7, atol=1e-12)


@pytest.mark.parametrize("wide", [2, 3, 4])
@pytest.mark.parametrize("turns", range(4))
def test_a_gap_continues_the_plane_of_what_is_measured_beside_it(turns, wide):
    y, x = np.mgrid[:9, :12]
    plane = np.rot90(0.02 * y - 0.05 * x, turns)
    height = plane.copy()
    height[:-wide] = np.nan
    # The measured strip is reflected about its border, so it continues over its own width.
    filled = slice(-2 * wide + 1, -wide)
    np.testing.assert_allclose(fill_gaps(height)[filled], plane[filled], atol=1e-12)


@pytest.mark.parametrize("matrix", [np.eye(2), np.zeros((3, 3)), np.full((3, 3), np.nan)])
def test_an_invalid_transform_is_refused(matrix):
    with pytest.raises(InputError, match="scan_to_layout"):
        resample_to_layout(np.ones((40, 40)), matrix, (40, 40), scan_pitch_um=(0.1, 0.1), layout_pitch_um=0.1)
