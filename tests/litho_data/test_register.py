"""Test registration: phantoms of known warp, the ladder of models, ambiguity, fallbacks, frames."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_data.register import Registration, apply_transform, centred_placement, register_scan
from litho_data.register.geometry import ORIENTATIONS, orient, orientation_matrix
from tests.litho_data.register_phantoms import (
    PITCH_UM,
    random_layout,
    scan_of,
    true_scan_to_layout,
    warp_about_centre,
    warp_error_px,
)

SHAPE, SCAN_SHAPE = (256, 280), (312, 344)
MARGIN_PX = (32.0, 28.0)
# For scans that must not pass, whose accuracy does not count.
SMALL, SMALL_SCAN, SMALL_MARGIN_PX = (224, 248), (274, 302), (27.0, 25.0)


def register(scan: np.ndarray, layout: np.ndarray, **options) -> Registration:
    return register_scan(
        scan, layout, scan_pitch_um=(PITCH_UM, PITCH_UM), layout_pitch_um=PITCH_UM, **options
    )


# These are rotations up to 3°, scales that differ by up to 8 % from one and each other, and blob sizes.
WARPS = [
    (3.0, (1.08, 1.0), 5.0),
    (-3.0, (0.92, 1.03), 5.0),
    (1.0, (0.97, 1.05), 9.0),
    (-2.0, (1.04, 0.96), 9.0),
]


@pytest.mark.parametrize("index", range(8))
def test_known_warp_is_recovered_at_snr_5_in_any_orientation_and_polarity(index):
    orientation, polarity = list(ORIENTATIONS)[index], 1 if index % 3 else -1
    rotation_deg, scale, blob_px = WARPS[index % len(WARPS)]
    layout = random_layout(SHAPE, seed=index, blob_px=blob_px)
    warp = warp_about_centre(
        SHAPE, rotation_deg=rotation_deg, scale=scale, shift_px=(4.3, -6.7), margin_px=MARGIN_PX
    )
    scan = scan_of(layout, warp, SCAN_SHAPE, snr=5, seed=index, orientation=orientation, polarity=polarity)
    found = register(scan, layout)
    truth = true_scan_to_layout(warp, orientation, SCAN_SHAPE)
    assert (found.quality.dihedral, found.quality.polarity) == (orientation, polarity)
    assert found.quality.passed, found.quality.reason
    # This is the required accuracy. The limit due to white noise at SNR 5 is about 0.025 px at a corner.
    assert warp_error_px(found.scan_to_layout, truth, SHAPE) < 0.3
    # The stated uncertainty must be right: no corner is wrong by more than six standard deviations.
    assert warp_error_px(found.scan_to_layout, truth, SHAPE) < 6 * found.quality.corner_sd_px + 0.02


RUNGS = {
    "translation": {},
    "euclidean": {"rotation_deg": 1.0},
    "similarity": {"rotation_deg": 1.0, "scale": (1.02, 1.02)},
    "affine": {"rotation_deg": 1.0, "scale": (1.03, 0.98)},
    "homography": {"rotation_deg": 1.0, "scale": (1.02, 0.99), "perspective": (4e-5, -3e-5)},
}


@pytest.mark.parametrize("rung", RUNGS)
def test_the_ladder_of_models_stops_at_the_model_of_the_phantom(rung):
    layout = random_layout(SHAPE, seed=11)
    warp = warp_about_centre(SHAPE, shift_px=(3.3, -4.6), margin_px=MARGIN_PX, **RUNGS[rung])
    found = register(scan_of(layout, warp, SCAN_SHAPE, snr=5, seed=1), layout, model="ladder")
    assert found.quality.model == rung
    error = warp_error_px(found.scan_to_layout, true_scan_to_layout(warp, "identity", SCAN_SHAPE), SHAPE)
    assert error < 0.3
    wanted_um = PITCH_UM * np.add((3.3, -4.6), MARGIN_PX)
    # The limit is again 0.3 px.
    shift_um = (found.quality.shift_x_um, found.quality.shift_y_um)
    assert shift_um == pytest.approx(wanted_um, abs=0.3 * PITCH_UM)


def test_homography_model_recovers_a_perspective_that_an_affine_cannot():
    layout = random_layout(SHAPE, seed=12)
    warp = warp_about_centre(SHAPE, perspective=(1e-4, -8e-5), margin_px=MARGIN_PX)
    scan = scan_of(layout, warp, SCAN_SHAPE, snr=5)
    truth = true_scan_to_layout(warp, "identity", SCAN_SHAPE)
    errors = {
        model: warp_error_px(register(scan, layout, model=model).scan_to_layout, truth, SHAPE)
        for model in ("affine", "homography")
    }
    # A perspective of 1e-4 / px displaces a corner 190 px from the centre by 1e-4 * 190**2 = 3.6 px.
    assert errors["homography"] < 0.3 < 1.0 < errors["affine"]


@pytest.mark.parametrize("period_px", [6, 16, 50])
@pytest.mark.parametrize("crossed", [False, True])
def test_a_grating_is_flagged_as_ambiguous(period_px, crossed):
    line = (np.arange(SMALL[1]) % period_px < period_px / 2).astype(np.uint8)
    column = (np.arange(SMALL[0]) % period_px < period_px / 2).astype(np.uint8)
    layout = 6 * line[None] + (6 * column[:, None] if crossed else 6 * np.ones_like(column)[:, None])
    warp = warp_about_centre(SMALL, rotation_deg=0.5, margin_px=SMALL_MARGIN_PX)
    quality = register(scan_of(layout, warp, SMALL_SCAN, snr=5), layout).quality
    assert not quality.passed
    assert "ambiguous: the layout repeats itself" in quality.reason


def test_a_symmetric_layout_is_taken_upright_with_a_warning():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    radius = np.hypot(y - (SHAPE[0] - 1) / 2, x - (SHAPE[1] - 1) / 2)
    layout = (6 + 5.9 * np.cos(radius**2 / 1000)).astype(np.uint8)
    warp = warp_about_centre(SHAPE, margin_px=MARGIN_PX, shift_px=(2.0, 1.0))
    found = register(scan_of(layout, warp, SCAN_SHAPE, snr=5), layout)
    assert found.quality.dihedral == "identity"
    assert "looks the same in another orientation" in found.quality.warning


def test_a_foreign_scan_fails_on_its_correlation():
    layout, other = (random_layout(SMALL, seed=seed) for seed in (1, 2))
    scan = scan_of(other, warp_about_centre(SMALL, margin_px=SMALL_MARGIN_PX), SMALL_SCAN, snr=5)
    quality = register(scan, layout).quality
    assert not quality.passed
    assert "correlation" in quality.reason


@pytest.mark.parametrize("empty", ["scan constant", "scan NaN", "layout constant"])
def test_without_structure_the_centred_placement_comes_back_as_failed(empty):
    layout = random_layout(SHAPE, seed=1)
    scan = scan_of(layout, warp_about_centre(SHAPE, margin_px=MARGIN_PX), SCAN_SHAPE)
    scan = {"scan constant": np.ones_like(scan), "scan NaN": np.full_like(scan, np.nan)}.get(empty, scan)
    layout = np.full_like(layout, 5) if empty == "layout constant" else layout
    found = register(scan, layout)
    assert not found.quality.passed
    assert found.quality.reason
    expected = centred_placement(SCAN_SHAPE, (PITCH_UM, PITCH_UM), SHAPE, PITCH_UM)
    np.testing.assert_array_equal(found.scan_to_layout, expected)


def test_correlation_takes_over_where_keypoints_are_too_few():
    # The layout has a few broad bumps, on which ORB finds no keypoints.
    layout = random_layout(SHAPE, seed=3, blob_px=30.0)
    warp = warp_about_centre(
        SHAPE, rotation_deg=0.5, scale=(1.04, 0.97), margin_px=MARGIN_PX, shift_px=(3.0, -2.0)
    )
    found = register(scan_of(layout, warp, SCAN_SHAPE, snr=5), layout)
    assert found.quality.method == "correlation"
    assert "coarse fit used only" in found.quality.warning
    assert warp_error_px(found.scan_to_layout, true_scan_to_layout(warp, "identity", SCAN_SHAPE), SHAPE) < 0.3


def test_a_small_layout_without_room_for_keypoints_is_registered_by_correlation():
    shape, scan_shape = (64, 72), (76, 84)
    layout = random_layout(shape, seed=4, blob_px=4.0)
    warp = warp_about_centre(shape, margin_px=(6.0, 6.0), shift_px=(1.4, -0.8))
    found = register(scan_of(layout, warp, scan_shape, snr=10), layout, model="translation")
    assert warp_error_px(found.scan_to_layout, true_scan_to_layout(warp, "identity", scan_shape), shape) < 0.3


def test_gaps_tilt_and_offset_do_not_move_the_warp():
    layout = random_layout(SHAPE, seed=5)
    warp = warp_about_centre(SHAPE, rotation_deg=0.7, scale=(1.02, 0.99), margin_px=MARGIN_PX)
    scan = scan_of(layout, warp, SCAN_SHAPE, snr=5)
    y, x = np.mgrid[: SCAN_SHAPE[0], : SCAN_SHAPE[1]]
    tilted = scan + 3.0 + 0.004 * x - 0.003 * y - 2e-6 * (x - 200.0) ** 2
    tilted[100:140, 200:260] = np.nan
    tilted[np.random.default_rng(0).random(SCAN_SHAPE) < 0.01] = np.nan
    found = register(tilted, layout)
    assert found.quality.passed, found.quality.reason
    assert warp_error_px(found.scan_to_layout, true_scan_to_layout(warp, "identity", SCAN_SHAPE), SHAPE) < 0.3


def test_a_scan_of_part_of_the_field_and_other_pitches_lands_in_micrometres():
    layout = random_layout(SHAPE, seed=6)
    pitch_um, shape = (0.08, 0.05), (240, 420)  # 19.2 µm × 21 µm of the 25.6 µm × 28 µm field
    origin_um = np.array([3.03, 2.96])
    index_of_layout = np.array(
        [
            [PITCH_UM / pitch_um[1], 0, (PITCH_UM / 2 - origin_um[0]) / pitch_um[1] - 0.5],
            [0, PITCH_UM / pitch_um[0], (PITCH_UM / 2 - origin_um[1]) / pitch_um[0] - 0.5],
            [0, 0, 1],
        ]
    )
    scan = scan_of(layout, index_of_layout, shape, snr=5)
    found = register_scan(scan, layout, scan_pitch_um=pitch_um, layout_pitch_um=PITCH_UM)
    assert found.quality.passed, found.quality.reason
    assert found.quality.overlap == pytest.approx(19.2 * 21 / (25.6 * 28), abs=0.01)
    ends_um = np.array([[0.0, 0], [21, 0], [0, 19.2], [21, 19.2]])
    error_um = np.abs(apply_transform(found.scan_to_layout, ends_um) - (ends_um + origin_um)).max()
    assert error_um < 0.3 * PITCH_UM


def test_the_result_does_not_depend_on_threads_or_on_being_run_twice():
    import cv2

    layout = random_layout(SHAPE, seed=7, blob_px=5.0)
    scan = scan_of(layout, warp_about_centre(SHAPE, rotation_deg=1.0, margin_px=MARGIN_PX), SCAN_SHAPE, snr=5)
    threads, results = cv2.getNumThreads(), []
    try:
        for count in (1, 2):
            cv2.setNumThreads(count)
            results.append(register(scan, layout))
    finally:
        cv2.setNumThreads(threads)
    first, again = results
    np.testing.assert_array_equal(again.scan_to_layout, first.scan_to_layout)
    assert asdict(again.quality) == asdict(first.quality)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_orientation_matrix_says_where_a_pixel_goes(orientation):
    image = np.arange(5 * 7).reshape(5, 7)
    turned = orient(image, orientation)
    y, x = np.mgrid[:5, :7]
    points = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    moved = apply_transform(orientation_matrix(orientation, image.shape), points).astype(int)
    np.testing.assert_array_equal(turned[moved[:, 1], moved[:, 0]], image.ravel())


@pytest.mark.parametrize(
    ("scan_shape", "pitch_um"), [((20, 20), 0.1), ((100, 100, 3), 0.1), ((100, 100), 0.0)]
)
def test_bad_arrays_and_pitches_are_refused(scan_shape, pitch_um):
    with pytest.raises(InputError):
        register_scan(
            np.zeros(scan_shape),
            random_layout((64, 64), 0),
            scan_pitch_um=(pitch_um, 0.1),
            layout_pitch_um=0.1,
        )
