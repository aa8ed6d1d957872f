"""Test levelling methods that Gwyddion does not have: robust, layout-aware, mask-and-relevel, scars."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from litho_data.foundation.errors import InputError
from litho_data.level import (
    layout_in_scan_frame,
    level_layout_aware,
    level_plane,
    level_polynomial,
    level_robust,
    mark_features,
    mark_scars,
    mask_and_relevel,
    remove_scars,
)
from litho_data.readers import read_layout, read_scan

SHAPE = (120, 160)
NOISE_UM = 0.01


def slopes(surface: np.ndarray) -> tuple[float, float]:
    """Return the mean slope of a surface per pixel, along x and y."""
    return float(np.diff(surface, axis=1).mean()), float(np.diff(surface, axis=0).mean())


def tilted_substrate(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a noisy surface with a tilt of (0.002, -0.001) µm per pixel, and the tilt alone."""
    ny, nx = SHAPE
    tilt = 0.002 * np.arange(nx)[None, :] - 0.001 * np.arange(ny)[:, None]
    return tilt + NOISE_UM * np.random.default_rng(seed).normal(size=SHAPE), tilt


def slope_error(removed: np.ndarray, tilt: np.ndarray) -> float:
    return float(np.abs(np.subtract(slopes(removed), slopes(tilt))).max())


# The standard error of a least-squares slope from n pixels spread evenly over a length N is
# sigma sqrt(12 / n) / N. The tests allow four standard errors, doubled because masked pixels and robust fits
# are less efficient.
SLOPE_TOLERANCE = 2 * 4 * NOISE_UM * np.sqrt(12 / (SHAPE[0] * SHAPE[1])) / SHAPE[0]


def test_robust_plane_ignores_a_printed_block() -> None:
    z, tilt = tilted_substrate(0)
    z[20:100, 90:150] += 1.0
    levelled = level_robust(z)
    assert slope_error(levelled.removed, tilt) < SLOPE_TOLERANCE
    # The main surface is set to zero, within the error of a mean over half the pixels.
    bare = levelled.height[:, :80]
    assert abs(np.median(bare)) < 5 * NOISE_UM / np.sqrt(bare.size)
    # Least squares is biased by the block.
    assert slope_error(levelled.removed, tilt) < 0.5 * slope_error(level_plane(z).removed, tilt)


def test_robust_agrees_with_least_squares_on_gaussian_noise() -> None:
    z, tilt = tilted_substrate(1)
    robust, plain = level_robust(z).removed, level_polynomial(z, total_degree=1).removed
    # Both fits are unbiased and have nearly the same variance, so they differ by less than a standard
    # error.
    assert slope_error(robust, plain) < SLOPE_TOLERANCE / 4
    assert slope_error(robust, tilt) < SLOPE_TOLERANCE


def test_robust_on_an_exact_plane_with_outliers_is_exact() -> None:
    _, tilt = tilted_substrate(0)
    z = tilt.copy()
    z[10:40, 10:40] += 3.0
    # Once Tukey's weights are zero in the block, only rounding errors remain.
    np.testing.assert_allclose(level_robust(z).removed, tilt, rtol=0, atol=1e-9)


def test_mask_and_relevel_finds_features_and_slope() -> None:
    z, tilt = tilted_substrate(2)
    features = np.zeros(SHAPE, dtype=bool)
    features[10:30, 20:60] = features[70:110, 90:150] = True
    z[features] += 0.2
    levelled, mask = mask_and_relevel(z, grow_px=1)
    assert mask[features].all()
    # Three sigmas exclude 0.27 % of the noise, and growing turns each marked pixel into five.
    assert mask[~ndimage.binary_dilation(features)].mean() < 2 * 5 * 0.0027
    assert slope_error(levelled.removed, tilt) < SLOPE_TOLERANCE


def test_mask_and_relevel_keeps_out_what_the_mask_excludes() -> None:
    z, tilt = tilted_substrate(3)
    z[:, 100:] += 0.002 * np.arange(60)
    mask = np.zeros(SHAPE, dtype=bool)
    mask[:, 100:] = True
    levelled, found = mask_and_relevel(z, mask=mask)
    assert found[mask].all()
    assert slope_error(levelled.removed, tilt) < 2 * SLOPE_TOLERANCE


@pytest.mark.parametrize("side", ["above", "below", "both"])
def test_features_are_marked_on_the_asked_side(side: str) -> None:
    z = NOISE_UM * np.random.default_rng(4).normal(size=SHAPE)
    z[10:20, 10:20], z[50:60, 50:60] = 1.0, -1.0
    marked = mark_features(z, threshold=10, side=side)
    assert marked[10:20, 10:20].all() == (side != "below")
    assert marked[50:60, 50:60].all() == (side != "above")
    assert marked.sum() == (200 if side == "both" else 100)
    assert mark_features(z, threshold=10, side=side, grow_px=1).sum() == marked.sum() // 100 * (144 - 4)


def printed(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a layout whose levels rise to the right on average, and its blurred print in µm."""
    rng = np.random.default_rng(seed)
    level = ndimage.gaussian_filter(rng.normal(size=SHAPE), 4)
    level = 6 + 3 * level / level.std() + np.linspace(-3, 3, SHAPE[1])[None, :]
    level = np.clip(np.round(level), 0, 12)
    return level, 0.1 * ndimage.gaussian_filter(level, 2.0)


def test_layout_aware_levelling_leaves_the_structure_its_own_slope() -> None:
    level, structure = printed(5)
    noise, tilt = tilted_substrate(6)
    z = noise + structure
    aware = level_layout_aware(z, layout_level=level, blur_px=2.0)
    # The fitted response is piecewise linear in the blurred level, like the print, so only noise remains.
    # Fitting it together with the tilt costs less than half of the precision.
    assert slope_error(aware.removed, tilt) < SLOPE_TOLERANCE
    # A plane fit mistakes the slope of the structure, 0.6 µm across the field, for a tilt.
    assert slope_error(level_plane(z).removed, tilt) > 100 * slope_error(aware.removed, tilt)
    # The mean height does not change.
    assert aware.height.mean() == pytest.approx(z.mean(), abs=1e-12)


def test_layout_aware_levelling_works_for_a_response_that_is_not_linear() -> None:
    level, _ = printed(7)
    noise, tilt = tilted_substrate(8)
    response = np.sqrt(np.arange(13)) + 0.3 * (np.arange(13) > 7)
    aware = level_layout_aware(noise + response[level.astype(int)], layout_level=level, blur_px=0.0)
    assert slope_error(aware.removed, tilt) < SLOPE_TOLERANCE


def test_the_background_is_found_equally_well_for_any_number_of_levels() -> None:
    # The print depends on the random levels only, not on the number of steps into which they are divided.
    smooth, _ = printed(12)
    noise, tilt = tilted_substrate(13)
    errors = []
    for levels in (64, 256, 65_536):
        fine = np.round((levels - 1) * ndimage.gaussian_filter(smooth, 1.0) / 12)
        z = noise + 1.2 / (levels - 1) * ndimage.gaussian_filter(fine, 2.0)
        errors.append(slope_error(level_layout_aware(z, layout_level=fine, blur_px=2.0).removed, tilt))
    assert max(errors) < SLOPE_TOLERANCE
    assert max(errors) == pytest.approx(min(errors), rel=0.1)


def test_levels_between_which_there_are_no_pixels_do_not_prevent_levelling() -> None:
    # Straight edges along y blur to a few levels only. The response between the other levels is unknown.
    noise, tilt = tilted_substrate(14)
    stripes = np.broadcast_to(12.0 * (np.arange(SHAPE[1]) // 16 % 2), SHAPE)
    z = noise + 0.1 * ndimage.gaussian_filter(stripes, 2.0)
    assert slope_error(level_layout_aware(z, layout_level=stripes).removed, tilt) < SLOPE_TOLERANCE


def test_layout_aware_levelling_with_gaps_and_mask() -> None:
    level, structure = printed(9)
    noise, tilt = tilted_substrate(10)
    z = noise + structure
    z[5:9, 5:9] = np.nan
    dirt = np.zeros(SHAPE, dtype=bool)
    dirt[60:80, 20:50] = True
    z[dirt] += 5.0
    level[:10] = np.nan
    aware = level_layout_aware(z, layout_level=level, blur_px=2.0, mask=dirt)
    # The blurred layout differs from the print next to the unknown rows. These few rows add some nm.
    assert slope_error(aware.removed, tilt) < 2 * SLOPE_TOLERANCE
    assert np.isfinite(aware.removed).all()


def test_a_layout_that_is_a_ramp_cannot_be_told_from_tilt() -> None:
    z, _ = tilted_substrate(11)
    ramp = np.broadcast_to(np.arange(SHAPE[1]) / 20.0, SHAPE)
    with pytest.raises(InputError, match="the layout cannot be told from the background"):
        level_layout_aware(z, layout_level=ramp, blur_px=0.0)
    # Whole levels differ from the ramp by their rounding, which is less and less as their number grows.
    with pytest.raises(InputError, match=r"an error \de\+03 times as large as without a layout"):
        level_layout_aware(z, layout_level=np.round(40 * ramp), blur_px=2.0)
    for wrong, message in ((np.zeros((3, 3)), "shape"), (np.full(SHAPE, np.nan), "covers no measured pixel")):
        with pytest.raises(InputError, match=message):
            level_layout_aware(z, layout_level=wrong)


def test_layout_in_scan_frame_follows_the_transform() -> None:
    layout = np.arange(6 * 4, dtype=np.uint8).reshape(6, 4)
    # The scan pixels are half as large, and are shifted by one layout pixel to the right and two down.
    shift = np.array([[1.0, 0.0, 0.1], [0.0, 1.0, 0.2], [0.0, 0.0, 1.0]])
    level = layout_in_scan_frame(layout, shift, (8, 8), (0.05, 0.05), 0.1)
    expected = np.full((8, 8), np.nan)
    expected[:, :6] = np.kron(layout[2:6, 1:4], np.ones((2, 2)))
    np.testing.assert_array_equal(level, expected)


@pytest.mark.measured
def test_a_tilt_added_to_a_measured_print_is_recovered(measured_prints: Path) -> None:
    """Check that a tilt that is added to a measured print is found again exactly."""
    scan = read_scan(measured_prints / "afm_ug" / "FOV61.txt", unit="m", size_um=(54, 54))
    layout = read_layout(measured_prints / "mask_ug" / "FOV61.tif")
    # This registration assumes the nominal pitch and a margin of 14 px on all sides. It is good to a few
    # pixels, which is enough for a blurred response.
    shift = np.array([[1.0, 0.0, -1.4], [0.0, 1.0, -1.4], [0.0, 0.0, 1.0]])
    level = layout_in_scan_frame(layout, shift, scan.shape, scan.require_pitch(), 0.1)
    before = level_layout_aware(scan.height_um, layout_level=level).removed
    tilt = 0.001 * np.arange(540)[None, :] - 0.0005 * np.arange(540)[:, None]
    after = level_layout_aware(scan.height_um + tilt, layout_level=level).removed
    # The fit is linear in the heights, so it returns the added tilt exactly, except for rounding.
    np.testing.assert_allclose(after - before, tilt - tilt[np.isfinite(level)].mean(), rtol=0, atol=1e-9)


def scarred(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a smooth surface, the same surface with scars, and the mask of the scars."""
    y, x = np.meshgrid(*(np.linspace(0, 3, n) for n in SHAPE), indexing="ij")
    smooth = 0.2 * np.sin(x) * np.cos(y)
    scars = np.zeros(SHAPE, dtype=bool)
    scars[30, 20:80] = scars[70:73, 50:100] = True
    rough = smooth + 0.0005 * np.random.default_rng(seed).normal(size=SHAPE)
    spoiled = rough.copy()
    spoiled[30, 20:80] += 0.3
    spoiled[70:73, 50:100] -= 0.3
    return smooth, spoiled, scars


def test_scars_are_found_and_filled() -> None:
    smooth, spoiled, scars = scarred(12)
    single = scars & (np.arange(SHAPE[0]) == 30)[:, None]
    found = mark_scars(spoiled)
    np.testing.assert_array_equal(found, scars)
    np.testing.assert_array_equal(mark_scars(spoiled, sign="positive"), single)
    filled = remove_scars(spoiled, scars=found)
    np.testing.assert_array_equal(filled.removed[~found], 0.0)
    # Over three rows, the curvature of the surface changes heights by less than 0.2 (3/120)² 2² / 2. The
    # noise on both sides adds to this.
    np.testing.assert_allclose(filled.height[scars], smooth[scars], rtol=0, atol=0.0025)


def test_scars_shorter_or_wider_than_asked_stay() -> None:
    _, spoiled, scars = scarred(13)
    single = scars & (np.arange(SHAPE[0]) == 30)[:, None]
    assert not mark_scars(spoiled, min_length_px=61).any()
    np.testing.assert_array_equal(mark_scars(spoiled, max_width_px=2), single)
    np.testing.assert_array_equal(mark_scars(spoiled, max_width_px=3), scars)
    np.testing.assert_array_equal(mark_scars(spoiled, max_width_px=1), single)
    assert not mark_scars(np.zeros(SHAPE)).any()


def test_filling_is_harmonic() -> None:
    """Check that a linear surface, which solves Laplace's equation, is restored in the marked pixels."""
    z = 0.1 * np.arange(30)[:, None] + 0.2 * np.arange(40)[None, :]
    marks = np.zeros(z.shape, dtype=bool)
    marks[5:12, 6:30] = marks[20, 20] = True
    filled = remove_scars(np.where(marks, 99.0, z), scars=marks)
    np.testing.assert_allclose(filled.height, z, rtol=0, atol=1e-12)


def test_filling_without_surroundings_is_refused() -> None:
    with pytest.raises(InputError, match="no measured neighbour"):
        remove_scars(np.zeros((5, 5)), scars=np.ones((5, 5), dtype=bool))
    with pytest.raises(InputError, match="scar mask"):
        remove_scars(np.zeros((5, 5)), scars=np.ones((5, 4), dtype=bool))
    with pytest.raises(InputError, match="scar parameters"):
        mark_scars(np.zeros((5, 5)), low=0.7)
