"""Nuisances: what lies in their span vanishes, what does not stays, and no pixel judges itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt

from litho_data.foundation.errors import InputError
from litho_data.register import Bend, resample_to_layout
from litho_models.scan_terms.nuisance import (
    POLICIES,
    TERM_COUNT,
    calibration_blocks,
    calibration_stripes,
    cross_fitted_residual,
    nuisance_basis,
    scan_line_index,
    shrunk_line_offsets,
)

SHAPE = (160, 192)


@pytest.fixture
def scan():
    random = np.random.default_rng(0)
    prediction = random.uniform(0.2, 0.8, SHAPE)
    return prediction, np.ones(SHAPE, bool), random


@pytest.mark.parametrize("split", [calibration_blocks, calibration_stripes])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_each_pixel_is_scored_once_and_calibration_keeps_its_distance(split, seed):
    halves = split(SHAPE, block_px=32, buffer_px=7, seed=seed)
    assert (halves[0].score ^ halves[1].score).all()
    for half in halves:
        distance = distance_transform_cdt(~half.score, metric="chessboard")
        assert distance[half.calibrate].min() > 7
        assert half.calibrate.any()


@pytest.mark.parametrize("policy", POLICIES)
def test_terms_of_the_policy_vanish_exactly(scan, policy):
    prediction, valid, _ = scan
    basis = nuisance_basis(prediction, policy)
    assert len(basis) == TERM_COUNT[policy]
    added = np.tensordot(np.linspace(0.02, -0.03, len(basis)), basis, axes=1)
    free = cross_fitted_residual(prediction + added, prediction, valid, policy)
    # Double precision, a handful of terms of order one.
    assert np.nanmax(np.abs(free.residual_um)) < 1e-12


@pytest.mark.parametrize(("policy", "freed"), [("none", False), ("offset", False), ("full", True)])
def test_a_bow_is_freed_only_by_the_policy_that_names_it(scan, policy, freed):
    prediction, valid, _ = scan
    y = np.linspace(-1, 1, SHAPE[0])[:, None]
    free = cross_fitted_residual(prediction + 0.05 * y**2, prediction, valid, policy)
    assert (np.nanstd(free.residual_um) < 1e-12) == freed


def test_offset_of_one_half_is_estimated_on_the_other(scan):
    prediction, valid, _ = scan
    first, second = calibration_blocks(SHAPE, block_px=32, buffer_px=7, seed=0)
    height = prediction + np.where(first.score, 0.1, 0.0)
    free = cross_fitted_residual(height, prediction, valid, "offset")
    # Each half is freed of the other's offset: the difference shows twice and never cancels.
    assert np.allclose(free.residual_um[first.score], 0.1)
    assert np.allclose(free.residual_um[second.score], -0.1)


def test_noise_is_not_fitted_away():
    random = np.random.default_rng(1)
    prediction = random.uniform(0.2, 0.8, (512, 512))
    noise = random.normal(0, 0.016, prediction.shape)
    free = cross_fitted_residual(prediction + noise, prediction, np.ones(noise.shape, bool), "full+rows")
    # White noise, no line offsets: shrinkage leaves them at zero, and seven terms on about 80,000
    # calibration pixels cost 16 nm * sqrt(7 / 80000) = 0.15 nm in quadrature, below 0.1 %.
    assert np.nanstd(free.residual_um) == pytest.approx(noise.std(), rel=1e-3)
    assert free.row_sd_um < 0.0005


def test_line_offsets_are_recovered_and_shrunk():
    random = np.random.default_rng(2)
    shape, sd, noise = (512, 512), 0.009, 0.016
    offsets = random.normal(0, sd, shape[0])
    prediction = random.uniform(0.2, 0.8, shape)
    height = prediction + offsets[:, None] + random.normal(0, noise, shape)
    free = cross_fitted_residual(height, prediction, np.ones(shape, bool), "full+rows")
    # 512 offsets fix their standard deviation to 1/sqrt(2*512) = 3 %; three times that.
    assert free.row_sd_um == pytest.approx(sd, rel=0.1)
    # About 144 calibration pixels per line leave 16/12 = 1.3 nm: sqrt(16² + 1.3²) = 16.05 nm.
    assert np.nanstd(free.residual_um) == pytest.approx(np.hypot(noise, noise / 12), rel=0.01)
    assert 300 < free.degrees_of_freedom - 7 < 512


def test_shrinkage_is_the_best_linear_prediction():
    random = np.random.default_rng(3)
    shape = (400, 256)
    truth = random.normal(0, 0.004, shape[0])
    residual = truth[:, None] + random.normal(0, 0.03, shape)
    lines = np.broadcast_to(np.arange(shape[0])[:, None], shape)
    offsets, weight, variance = shrunk_line_offsets(residual, np.ones(shape, bool), lines)
    noise = 0.03**2 / shape[1]
    # v/(v + noise) = 0.82; both variances are known to about 10 % from 400 lines.
    assert weight.mean() == pytest.approx(0.004**2 / (0.004**2 + noise), abs=0.05)
    assert variance == pytest.approx(0.004**2, rel=0.25)
    plain = residual.mean(axis=1)
    assert np.mean((offsets - truth) ** 2) < np.mean((plain - truth) ** 2)


def test_scan_lines_of_a_rotated_scan_are_tilted_rows():
    angle = np.deg2rad(0.5)
    rotate = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    line = scan_line_index((512, 512), rotate, 0.1)
    # A scan line turned by +0.5° descends tan(0.5°) * 511 = 4.46 px from left to right (y down), so
    # along one layout row the index falls by that.
    assert line[256, 0] - line[256, -1] in (4, 5)
    assert scan_line_index((8, 8), np.eye(3), 0.1).tolist() == [[row] * 8 for row in range(8)]


def test_scan_lines_of_a_bent_scan_are_the_lines_it_was_scanned_in():
    shape, pitch_um = (120, 140), (0.1, 0.1)
    bend = Bend.of_scan(np.array([[0.1, -0.05, 0.1], [0.15, 0.1, -0.2]]), shape, pitch_um)
    line = scan_line_index(shape, np.eye(3), 0.1, bend)
    # A scan whose height is its place across the lines, in pixels, registered. A spline reproduces a ramp
    # but for its mirrored ends, which decay by 0.27 per pixel: 1e-5 after 9; float32 is good to 1e-5.
    ramp = np.broadcast_to(np.arange(shape[0])[:, None] + 0.5, shape)
    height, valid = resample_to_layout(
        ramp, np.eye(3), shape, scan_pitch_um=pitch_um, layout_pitch_um=0.1, bend_um=bend
    )
    clear = valid & (np.abs(height - np.rint(height)) > 1e-4) & (height > 9) & (height < shape[0] - 9)
    assert np.ptp(np.floor(height[clear]) - line[clear]) == 0
    # Without the bend the lines would be rows; it moves places by up to 0.4 µm.
    assert np.ptp(line - np.arange(shape[0])[:, None]) > 2


def test_what_a_bent_scan_does_not_show_is_in_its_first_or_last_line():
    bend = Bend.of_scan(np.zeros((2, 3)), (40, 40), (0.1, 0.1))
    # The layout begins 10 px above the scan's first line and ends 10 px below its last.
    ten_px_down = np.array([[1, 0, 0], [0, 1, 1.0], [0, 0, 1]])
    line = scan_line_index((60, 40), ten_px_down, 0.1, bend)
    # A place on the border of two lines may round into either, so it is the number of lines that is exact.
    assert line.max() == 39
    assert (line[:10] == 0).all()
    assert (line[50:] == 39).all()


def test_nan_pixels_neither_count_nor_are_fitted(scan):
    prediction, valid, _ = scan
    height = prediction + 0.03
    height[20:60, 30:90] = np.nan
    free = cross_fitted_residual(height, prediction, valid, "offset")
    assert np.isnan(free.residual_um[20:60, 30:90]).all()
    assert np.nanmax(np.abs(free.residual_um)) < 1e-12


@pytest.mark.parametrize(
    "call",
    [
        lambda: nuisance_basis(np.zeros((4, 4)), "bow"),
        lambda: calibration_blocks((64, 64), block_px=8, buffer_px=7),
        lambda: cross_fitted_residual(np.zeros((64, 64)), np.zeros((64, 60)), np.ones((64, 64), bool)),
        lambda: cross_fitted_residual(np.zeros((64, 64)), np.full((64, 64), np.nan), np.ones((64, 64), bool)),
        lambda: cross_fitted_residual(np.zeros((8, 8)), np.zeros((8, 8)), np.ones((8, 8), bool), "full"),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(InputError):
        call()
