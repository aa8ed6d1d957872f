"""Check that scan terms remove only errors in their span, and that no pixel calibrates its own score."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt, gaussian_filter

from litho_data.foundation.errors import InputError
from litho_data.register import Bend, resample_to_layout
from litho_models.effects import get_effect
from litho_models.scan_terms import (
    POLICIES,
    SCAN_TERMS,
    Blocks,
    NuisanceProtocol,
    Policy,
    ScanTerm,
    TermPixels,
    chosen_terms,
    cross_fit,
    line_terms,
    parameter_names,
    policy_terms,
    register_scan_term,
    row_index,
    scan_line_index,
    shrunk_line_offsets,
    term_maps,
)
from litho_models.scan_terms.blocks import checkerboard, line_cells

SHAPE = (160, 192)


@pytest.fixture
def scan():
    random = np.random.default_rng(0)
    prediction = random.uniform(0.2, 0.8, SHAPE)
    return prediction, np.ones(SHAPE, bool), random


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_each_pixel_is_scored_once_and_calibration_keeps_its_distance(seed):
    halves = checkerboard(SHAPE, Blocks(seed=seed))
    assert (halves[0].score ^ halves[1].score).all()
    for half in halves:
        distance = distance_transform_cdt(~half.score, metric="chessboard")
        assert distance[half.calibrate].min() > 7
        assert half.calibrate.any()


@pytest.mark.parametrize("axes", [(1,), (0,), (0, 1)])
def test_lines_are_estimated_beyond_a_gap_on_the_other_side(axes):
    cells = line_cells(SHAPE, axes, 32)
    assert len(cells) == 2 ** len(axes)
    assert (np.sum([cell.score for cell in cells], axis=0) == 1).all()
    place = np.indices(SHAPE)
    for cell in cells:
        for axis, other in cell.other_side.items():
            scored, used = place[axis][cell.score], place[axis][other]
            # Along a line, every calibration pixel is at least 32 px from every scored pixel.
            assert min(abs(int(used.min()) - scored.max()), abs(int(used.max()) - scored.min())) > 32 - 1
            assert other.any()


def test_the_catalogue_is_complete_and_consistent():
    pixels = TermPixels(np.random.default_rng(0).uniform(size=(40, 50)))
    everything = term_maps(pixels, SCAN_TERMS)
    assert len(everything) == len(parameter_names(SCAN_TERMS)) == len(set(parameter_names(SCAN_TERMS)))
    some = np.array([3, 77, 1999])
    assert np.allclose(term_maps(TermPixels(pixels.prediction_um, at=some), SCAN_TERMS), everything[:, some])
    for term in chosen_terms(SCAN_TERMS):
        assert (term.maps is None) != (term.lines is None)
        # Only the datum has a mean, except for displacement terms, which are proportional to the slopes.
        if term.maps is not None and term.unit != "px" and term.name != "offset":
            assert np.abs(term.maps(pixels).mean(axis=1)).max() < 1e-12


def test_a_scan_term_stands_for_an_effect_of_single_scans():
    for term in SCAN_TERMS.values():
        if term.effect is not None:
            assert get_effect(term.effect).per_scan


def test_policies_are_named_sets_of_terms():
    assert tuple(POLICIES) == get_args(Policy)
    for policy, terms in POLICIES.items():
        smooth = sum(len(t.labels) for t in chosen_terms(terms) if t.maps is not None)
        assert NuisanceProtocol.of_policy(policy).k == smooth
    assert [NuisanceProtocol.of_policy(p).k for p in POLICIES] == [0, 1, 2, 7, 7]
    assert [t.name for t in line_terms(POLICIES["full+rows"])] == ["layout-rows"]


def test_a_term_of_ones_own_is_used_like_the_others(monkeypatch):
    monkeypatch.setattr("litho_models.scan_terms.term.SCAN_TERMS", dict(SCAN_TERMS))
    register_scan_term(
        ScanTerm(
            "ripple",
            None,
            "µm",
            ("ripple along y",),
            maps=lambda pixels: np.sin(20 * pixels.smooth[1])[None] - np.sin(20 * pixels.smooth[1]).mean(),
        )
    )
    prediction = np.random.default_rng(4).uniform(0.2, 0.8, SHAPE)
    ripple = 0.02 * np.sin(20 * np.linspace(-1, 1, SHAPE[0]))[:, None]
    valid = np.ones(SHAPE, bool)
    with_it = cross_fit(prediction + ripple, prediction, valid, frozenset({"offset", "ripple"}))
    without = cross_fit(prediction + ripple, prediction, valid, POLICIES["offset"])
    assert np.nanmax(np.abs(with_it.residual_um)) < 1e-12
    assert np.nanstd(without.residual_um) > 0.01
    with pytest.raises(InputError, match="exists"):
        register_scan_term(ScanTerm("ripple", None, "µm", ("again",), maps=lambda p: p.height[None]))


@pytest.mark.parametrize("policy", POLICIES)
def test_terms_of_the_policy_vanish_exactly(scan, policy):
    prediction, valid, _ = scan
    basis = term_maps(TermPixels(prediction), POLICIES[policy])
    added = (np.linspace(0.02, -0.03, len(basis)) @ basis).reshape(SHAPE)
    free = cross_fit(prediction + added, prediction, valid, POLICIES[policy])
    # The sum has a few terms of order one, in double precision.
    assert np.nanmax(np.abs(free.residual_um)) < 1e-12


@pytest.mark.parametrize(("policy", "freed"), [("none", False), ("offset", False), ("full", True)])
def test_a_bow_is_freed_only_by_the_policy_that_names_it(scan, policy, freed):
    prediction, valid, _ = scan
    y = np.linspace(-1, 1, SHAPE[0])[:, None]
    free = cross_fit(prediction + 0.05 * y**2, prediction, valid, POLICIES[policy])
    assert (np.nanstd(free.residual_um) < 1e-12) == freed


def test_offset_of_one_half_is_estimated_on_the_other(scan):
    prediction, valid, _ = scan
    first, second = checkerboard(SHAPE, Blocks())
    height = prediction + np.where(first.score, 0.1, 0.0)
    free = cross_fit(height, prediction, valid, POLICIES["offset"])
    # The offset of each half is subtracted from the other half, so the difference appears in both.
    assert np.allclose(free.residual_um[first.score], 0.1)
    assert np.allclose(free.residual_um[second.score], -0.1)


def test_noise_is_not_fitted_away():
    random = np.random.default_rng(1)
    prediction = random.uniform(0.2, 0.8, (512, 512))
    noise = random.normal(0, 0.016, prediction.shape)
    free = cross_fit(prediction + noise, prediction, np.ones(noise.shape, bool), POLICIES["full+rows"])
    # White noise has no line offsets, so shrinkage keeps them at zero. Seven terms from about 80,000
    # calibration pixels add 16 nm * sqrt(7 / 80000) = 0.15 nm in quadrature, below 0.1 %.
    assert np.nanstd(free.residual_um) == pytest.approx(noise.std(), rel=1e-3)
    rows = row_index(noise.shape)
    assert shrunk_line_offsets(noise, np.ones(noise.shape, bool), rows, 32)[2] < 0.0005**2


def test_line_offsets_are_recovered_and_shrunk():
    random = np.random.default_rng(2)
    shape, sd, noise = (512, 512), 0.009, 0.016
    offsets = random.normal(0, sd, shape[0])
    prediction = random.uniform(0.2, 0.8, shape)
    height = prediction + offsets[:, None] + random.normal(0, noise, shape)
    free = cross_fit(height, prediction, np.ones(shape, bool), POLICIES["full+rows"])
    # The standard deviation of 512 offsets is known to 1/sqrt(2*512) = 3 %. Allow three times this.
    _, _, variance = shrunk_line_offsets(height - prediction, np.ones(shape, bool), row_index(shape), 32)
    assert variance**0.5 == pytest.approx(sd, rel=0.1)
    # From 224 pixels beyond the gap, an offset has an error of 16/15 = 1.1 nm: sqrt(16² + 1.1²) = 16.04 nm.
    assert np.nanstd(free.residual_um) == pytest.approx(np.hypot(noise, noise / 15), rel=0.01)
    assert 300 < free.degrees_of_freedom - 7 < 512


def test_shrinkage_is_the_best_linear_prediction():
    random = np.random.default_rng(3)
    shape = (400, 256)
    truth = random.normal(0, 0.004, shape[0])
    residual = truth[:, None] + random.normal(0, 0.03, shape)
    lines = np.broadcast_to(np.arange(shape[0])[:, None], shape)
    offsets, weight, variance = shrunk_line_offsets(residual, np.ones(shape, bool), lines, 32)
    noise = 0.03**2 / shape[1]
    # v/(v + noise) is 0.82. From 400 lines, both variances are known to about 10 %.
    assert weight.mean() == pytest.approx(0.004**2 / (0.004**2 + noise), abs=0.05)
    assert variance == pytest.approx(0.004**2, rel=0.25)
    plain = residual.mean(axis=1)
    assert np.mean((offsets - truth) ** 2) < np.mean((plain - truth) ** 2)


def test_scan_lines_of_a_rotated_scan_are_tilted_rows():
    angle = np.deg2rad(0.5)
    rotate = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    line = scan_line_index((512, 512), rotate, 0.1)
    # A scan line rotated by +0.5° descends by tan(0.5°) * 511 = 4.46 px from left to right (y is down), so
    # the line index decreases by that along a layout row.
    assert line[256, 0] - line[256, -1] in (4, 5)
    assert scan_line_index((8, 8), np.eye(3), 0.1).tolist() == [[row] * 8 for row in range(8)]


def test_scan_lines_of_a_bent_scan_are_the_lines_it_was_scanned_in():
    shape, pitch_um = (120, 140), (0.1, 0.1)
    bend = Bend.of_scan(np.array([[0.1, -0.05, 0.1], [0.15, 0.1, -0.2]]), shape, pitch_um)
    line = scan_line_index(shape, np.eye(3), 0.1, bend)
    # The height of this registered scan is the position across the lines in pixels. A spline reproduces a
    # ramp except near its mirrored ends, whose effect decays by 0.27 per pixel, to 1e-5 after 9 px.
    ramp = np.broadcast_to(np.arange(shape[0])[:, None] + 0.5, shape)
    height, valid = resample_to_layout(
        ramp, np.eye(3), shape, scan_pitch_um=pitch_um, layout_pitch_um=0.1, bend_um=bend
    )
    clear = valid & (np.abs(height - np.rint(height)) > 1e-4) & (height > 9) & (height < shape[0] - 9)
    assert np.ptp(np.floor(height[clear]) - line[clear]) == 0
    # Without the bend, lines would be rows. The bend displaces positions by up to 0.4 µm.
    assert np.ptp(line - np.arange(shape[0])[:, None]) > 2


def test_what_a_bent_scan_does_not_show_is_in_its_first_or_last_line():
    bend = Bend.of_scan(np.zeros((2, 3)), (40, 40), (0.1, 0.1))
    # The layout begins 10 px above the scan's first line and ends 10 px below its last.
    ten_px_down = np.array([[1, 0, 0], [0, 1, 1.0], [0, 0, 1]])
    line = scan_line_index((60, 40), ten_px_down, 0.1, bend)
    # A position between two lines may be rounded to either, so only the number of lines is exact.
    assert line.max() == 39
    assert (line[:10] == 0).all()
    assert (line[50:] == 39).all()


def test_roughness_beside_the_scored_pixels_is_not_taken_for_an_offset_of_the_line():
    """Check roughness that is correlated over 20 px along x. It looks like an offset only near scored
    pixels.
    """
    random = np.random.default_rng(6)
    shape = (128, 256)
    rough = gaussian_filter(random.normal(size=shape), (0, 15.0))
    rough *= 0.01 / rough.std()
    prediction, valid = np.zeros(shape), np.ones(shape, bool)
    # With a gap of 1 px, pixels next to the split would be calibrated by their neighbours.
    near, far = (
        cross_fit(rough, prediction, valid, frozenset({"offset", "layout-rows"}), Blocks(line_gap_px=gap))
        for gap in (0, 32)
    )
    plain = cross_fit(rough, prediction, valid, POLICIES["offset"])
    edge = (slice(None), slice(118, 138))

    def gain(free):
        return 1 - np.nanmean(free.residual_um[edge] ** 2) / np.nanmean(plain.residual_um[edge] ** 2)

    assert gain(far) < 0.5 * gain(near)


def test_nan_pixels_neither_count_nor_are_fitted(scan):
    prediction, valid, _ = scan
    height = prediction + 0.03
    height[20:60, 30:90] = np.nan
    free = cross_fit(height, prediction, valid, POLICIES["offset"])
    assert np.isnan(free.residual_um[20:60, 30:90]).all()
    assert np.nanmax(np.abs(free.residual_um)) < 1e-12


@pytest.mark.parametrize(
    "call",
    [
        lambda: policy_terms("bow"),
        lambda: chosen_terms({"offset", "wobble"}),
        lambda: checkerboard((64, 64), Blocks(block_px=8)),
        lambda: cross_fit(np.zeros((64, 64)), np.zeros((64, 60)), np.ones((64, 64), bool), frozenset()),
        lambda: cross_fit(
            np.zeros((64, 64)), np.full((64, 64), np.nan), np.ones((64, 64), bool), frozenset()
        ),
        lambda: cross_fit(np.zeros((8, 8)), np.zeros((8, 8)), np.ones((8, 8), bool), POLICIES["full"]),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(InputError):
        call()
