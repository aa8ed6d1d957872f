"""Probes: what is planted comes back where it was planted; where nothing is, nothing is taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, map_coordinates, shift

from litho_models.loop.fold_fits import FoldFits
from litho_models.loop.linear import ALL_FREE
from litho_models.twin.prepared import PreparedScan, prepare_scans
from litho_models.loop.probes import Probed, probe_residual, with_intervals
from litho_models.loop.probes.defects import find_defects
from litho_models.loop.probes.kernel import missing_kernel, off_centre_peak, resampled
from litho_models.loop.probes.layout import LAYOUT_FEATURES, _rows, layout_features
from litho_models.loop.probes.linear import Left, held_out_ridge
from litho_models.loop.probes.places import PROFILE_SPLINES, SPLINES, _over, drawn, drawn_profile, shifts
from litho_models.loop.probes.probe import Probe
from litho_models.loop.probes.selection import (
    GENERIC,
    SMALLEST_AGREEMENT,
    _anchors,
    _corrected,
    generic_terms,
)
from litho_models.loop.probes.tables import SPOT_UM
from litho_models.loop.probes.trend import order_trends
from litho_models.loop.report.plots import probe_figure
from litho_models.loop.study import State, Study
from litho_models.scan_terms import POLICIES, TermPixels, Terms, term_maps
from tests.litho_models.loop_scans import printed_scans, true_model

COUNT, SIZE_PX, NOISE_UM = 10, 96, 0.006
FOLD_OF = np.arange(COUNT) % 5


def scene(
    change: Callable[[PreparedScan], np.ndarray] | None = None, seed: int = 3, size_px: int = SIZE_PX
) -> tuple[list[PreparedScan], list[np.ndarray]]:
    """Scans of a known model with a change added to their height, and the known model's predictions."""
    scans = printed_scans(count=COUNT, size_px=size_px, noise_um=NOISE_UM, seed=seed)
    chain = true_model({})
    predictions = []
    for scan in prepare_scans(scans):
        with torch.no_grad():
            predictions.append(chain(scan.layout, scan.context)[0, 0].numpy())
    if change is not None:
        scans = [
            replace(f.stored, height_um=(f.stored.height_um + change(f)).astype(np.float32))
            for f in prepare_scans(scans)
        ]
    return prepare_scans(scans), predictions


def probed(scans: list[PreparedScan], predictions: list[np.ndarray]) -> Probed:
    nothing = np.empty(0)
    fits = FoldFits(true_model({}), nothing, np.empty((5, 0)), np.zeros(5), np.empty((0, 0)), [])
    return probe_residual(
        State(fits, predictions), Study(scans, FOLD_OF, floor_nm2=(1e3 * NOISE_UM) ** 2),
        frozenset({"offset", "bow"}),
    )  # fmt: skip


class _Planted(NamedTuple):
    """A probe whose correction is given: (parameters, scan) -> (y, x) µm."""

    given: Callable[[np.ndarray, PreparedScan], np.ndarray]
    free: Terms

    def correction(self, parameters: np.ndarray, scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        return self.given(parameters, scan)

    at_samples = Probe.at_samples


@pytest.mark.parametrize("free", [POLICIES["full"], ALL_FREE], ids=["full", "with warp"])
def test_a_correction_moves_nothing_that_the_probe_was_estimated_free_of(free: Terms) -> None:
    scans = prepare_scans(printed_scans(count=3, size_px=64, seed=3))
    random = np.random.default_rng(0)
    predictions = [gaussian_filter(random.random((64, 64)), 3).astype(np.float32) for _ in scans]
    shared = [term_maps(TermPixels(p), free) for p in predictions]
    amounts = random.normal(size=len(shared[0])) / 4
    own = {f.id: random.normal(size=(64, 64)) for f in scans}
    of = {f.id: (amounts @ s).reshape(64, 64) for f, s in zip(scans, shared, strict=True)}
    changes: list[list[np.ndarray]] = []
    for scale in (0.0, 1.0):
        probe: Any = _Planted(lambda parameters, scan: parameters * own[scan.id] + of[scan.id], free)
        parameters = np.array(scale)
        (anchor,) = _anchors(probe, parameters[None], scans, predictions)
        both = zip(scans, predictions, strict=True)
        changes.append([_corrected(probe, parameters, anchor, f, p) - p for f, p in both])
    # What is shared alone vanishes, to the float32 of a prediction.
    assert max(np.abs(change).max() for change in changes[0]) < 1e-5
    # Of anything else nothing shared is left where the probe is estimated.
    left = sum(
        np.stack([f.at_sample(row.reshape(64, 64)) for row in s]) @ f.at_sample(change) / len(f.sample)
        for f, s, change in zip(scans, shared, changes[1], strict=True)
    )
    assert np.abs(left).max() < 1e-5
    assert all(change.std() > 0.5 for change in changes[1])


@pytest.mark.slow
def test_every_probe_is_found_under_its_name() -> None:
    scans, predictions = scene()
    defects = find_defects(scans, predictions)
    assert [probe.name for probe in generic_terms(scans, predictions, defects)] == list(GENERIC)
    # What is summed at the sampled pixels is what is added there.
    for probe in generic_terms(scans, predictions, defects, [*GENERIC, LAYOUT_FEATURES]):
        parameters = probe.held_out(np.arange(len(scans)) % 5).per_fold[:2]
        added = [scans[0].at_sample(probe.correction(one, scans[0], predictions[0])) for one in parameters]
        sampled = probe.at_samples(parameters, scans[0], predictions[0])
        assert np.abs(sampled - added).max() < 1e-5 * max(np.abs(added).max(), 1e-3), probe.name
    for name in ("missing-kernel", "row-gain-profile"):
        assert [probe.name for probe in generic_terms(scans, predictions, defects, [name])] == [name]


def test_nothing_is_taken_where_nothing_is_missing() -> None:
    found = probed(*scene())
    assert found.added == []
    assert all(test.reason for test in found.tests)


@pytest.mark.slow
def test_a_response_displaced_from_the_layout_comes_back_in_place_and_size() -> None:
    """A ghost of 3 % of the layout, 0.8 µm down and 0.6 µm to the left."""
    found = probed(*scene(lambda f: 0.03 * np.roll(f.stored.layout_um, (8, -6), (0, 1)), size_px=128))
    assert found.added[0].probe.name == "missing-kernel"
    entry = found.added[0]
    values = {name: value for name, (value, _, _) in with_intervals(entry.probe, entry.estimate).items()}
    # EFFECTS asks for 1 px = 0.1 µm in place; the peak is read on a grid of 0.05 µm.
    assert values["peak_y"] == pytest.approx(0.8, abs=0.1)
    assert values["peak_x"] == pytest.approx(-0.6, abs=0.1)
    assert values["peak_amplitude"] == pytest.approx(0.03, rel=0.2)
    assert entry.after.rmse_nm < 0.5 * (entry.before.rmse_nm + 1e3 * NOISE_UM)


@pytest.mark.long
def test_a_copy_far_from_the_layout_comes_back_in_place_and_size() -> None:
    """3 % of the layout again 5 µm away: the kernel reaches 1.6 µm on fields of 12.8 µm."""
    moved = (40, -30)
    found = probed(
        *scene(lambda f: 0.03 * shift(f.stored.layout_um, moved, order=0, mode="nearest"), size_px=128)
    )
    entry = found.added[0]
    assert entry.probe.name == "displaced-copy"
    values = {name: value for name, (value, _, _) in with_intervals(entry.probe, entry.estimate).items()}
    # Places are 0.2 µm apart.
    assert values["shift_y"] == pytest.approx(4.0, abs=0.1)
    assert values["shift_x"] == pytest.approx(-3.0, abs=0.1)
    assert values["amount"] == pytest.approx(0.03, rel=0.2)
    assert probe_figure(entry).axes


def test_a_product_of_slope_and_height_comes_back_as_powers_of_the_shape() -> None:
    scans, predictions = scene()
    along_x = {
        f.id: p * np.abs(np.gradient(p.astype(float), f.stored.pitch_um, axis=1))
        for f, p in zip(scans, predictions, strict=True)
    }
    found = probed(*scene(lambda f: 0.03 * along_x[f.id]))
    assert found.added[0].probe.name == "shape-powers"
    assert found.added[0].after.rmse_nm < 1.05 * 1e3 * NOISE_UM
    assert probe_figure(found.added[0]).axes


def test_a_jump_over_the_order_is_seen() -> None:
    scans, predictions = scene()
    along_y = {
        f.id: np.abs(np.gradient(p.astype(float), f.stored.pitch_um, axis=0))
        for f, p in zip(scans, predictions, strict=True)
    }
    # Half as much before and after: the mean over the scans a base model takes up.
    entry = probed(*scene(lambda f: 0.02 * ((f.context.order > 0) - 0.5) * along_y[f.id])).added[0]
    assert entry.probe.name == "order-shapes"
    assert probe_figure(entry).axes


def test_a_jump_over_the_rows_is_seen() -> None:
    def jump(scan: PreparedScan) -> np.ndarray:
        return 0.008 * (np.arange(SIZE_PX) > 50)[:, None] * np.ones(SIZE_PX)

    found = probed(*scene(jump))
    assert found.added[0].probe.name == "row-profile"


@pytest.mark.slow
def test_a_law_without_a_covariate_is_left_to_the_features_of_the_layout() -> None:
    """Height where a ring of 0.8 to 1.6 µm differs from its inside: what a pixel has itself holds half."""

    def ringed(scan: PreparedScan) -> np.ndarray:
        layout, pitch_um = scan.stored.layout_um, scan.stored.pitch_um
        return 1.5 * (gaussian_filter(layout, 0.8 / pitch_um) - gaussian_filter(layout, 1.6 / pitch_um)) ** 2

    scans, predictions = scene(ringed)
    found = probed(scans, predictions)
    assert found.added[-1].probe.name == LAYOUT_FEATURES
    study = Study(scans, FOLD_OF, floor_nm2=(1e3 * NOISE_UM) ** 2)
    planted, traced, after = (
        state.score(study, ALL_FREE).mse_nm2.mean() - study.floor_nm2
        for state in (replace(found.state, predictions=predictions), found.traced, found.state)
    )
    # Above the noise 681, 357 and 92 nm²: the terms before it leave half, it takes three quarters of that.
    assert traced > 0.4 * planted
    assert after < 0.4 * traced


def test_the_features_are_the_same_at_the_sampled_pixels_and_over_the_field() -> None:
    """A correction is made by tiles, with the scale of its columns taken out again."""
    scans, predictions = scene()
    probe = layout_features(Left(scans, predictions, [np.ones(len(f.sample), bool) for f in scans]))
    assert probe is not None
    size = len(probe.penalty)
    coefficients = np.random.default_rng(0).normal(size=size)
    for scan, prediction in list(zip(scans, predictions, strict=True))[:2]:
        rows = _rows(scan, prediction, **probe.map_of.keywords)  # type: ignore[attr-defined]
        whole = scan.at_sample(probe.correction(coefficients, scan, prediction))
        # 216 terms of up to 22, rounded to 2^-24 of their size: 216 · 22 · 2^-24.
        assert whole == pytest.approx(coefficients @ rows, abs=size * np.abs(rows).max() * 2**-24)


def test_controls_are_the_fits_of_residuals_upside_down() -> None:
    """All draws at once, by one factor of each system, as one after another."""
    scans, predictions = scene(lambda scan: 0.05 * gaussian_filter(scan.stored.layout_um, 3))
    defects = find_defects(scans, predictions)
    (probe,) = generic_terms(scans, predictions, defects, ["level-table"])
    signs = np.random.default_rng(5).choice([-1.0, 1.0], size=(4, COUNT, 1))
    one_by_one = [
        held_out_ridge(probe.grams, s * probe.rights, probe.pixels, probe.penalty, FOLD_OF).mean_gain_nm2
        for s in signs
    ]
    probe = replace(probe, shuffle=None)
    assert probe.controls(FOLD_OF, np.random.default_rng(5), 4) == pytest.approx(one_by_one, rel=1e-9)


@pytest.mark.slow
def test_a_wrong_level_comes_back_at_its_level() -> None:
    """Level 6 printed 50 nm too high, spread by the spot like everything printed."""

    def one_level(scan: PreparedScan) -> np.ndarray:
        sigma_px = SPOT_UM / scan.stored.pitch_um
        return 0.05 * gaussian_filter((scan.stored.mask_level == 6).astype(float), sigma_px, mode="nearest")

    scans, predictions = scene(one_level)
    found = probed(scans, predictions)
    entry = next(e for e in found.added if e.probe.name == "level-table")
    values = with_intervals(entry.probe, entry.estimate)
    heights = np.array([value for value, _, _ in values.values()])
    levels = [int(name.removeprefix("level_")) for name in values]
    own = heights[levels.index(6)] - (heights[levels.index(5)] + heights[levels.index(7)]) / 2
    assert levels[int(np.argmax(heights))] == 6
    # What all scans share stays where it was: a datum that a probe cannot know is not made up.
    before, after = (
        np.mean([np.mean(f.stored.height_um - p) for f, p in zip(scans, one, strict=True)])
        for one in (predictions, found.state.predictions)
    )
    assert abs(after) <= abs(before) + 1e-3
    # The second difference at the level is what no datum, gain or slope over levels can carry.
    assert own == pytest.approx(50, rel=0.2)


def test_halves_of_the_scans_agree_on_a_response_that_needs_much_regularisation() -> None:
    """A wave of 3 µm along the diagonal, 7 nm rms beside 6 nm of noise; at a tenth of the power: 0.44."""

    def ringing(scan: PreparedScan) -> np.ndarray:
        frequencies = (np.fft.fftfreq(n, scan.stored.pitch_um) for n in scan.stored.shape)
        along = np.add.outer(*frequencies) / np.sqrt(2)
        transfer = sum(1 / (1 + (2 * np.pi * 3 * (along - sign / 3)) ** 2) for sign in (-1, 1))
        return 0.05 * np.fft.ifft2(transfer * np.fft.fft2(scan.stored.layout_um)).real

    scans, predictions = scene(ringing)
    kernel = missing_kernel(scans, predictions, find_defects(scans, predictions).masks)
    assert kernel.agreement() >= SMALLEST_AGREEMENT


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "along", "across", "direction"),
    [("axis-slope-table", "x", "y", 0.0), ("diagonal-slope-table", "diagonal", "antidiagonal", np.pi / 4)],
)
def test_what_grows_with_the_slope_along_one_direction_comes_back_as_a_table_of_it(
    name: str, along: str, across: str, direction: float
) -> None:
    """Lost heights of 40 nm per unit slope along x or a diagonal, none across."""
    scans, predictions = scene()
    steepness = {}
    for f, p in zip(scans, predictions, strict=True):
        y, x = np.gradient(p.astype(float), f.stored.pitch_um)
        steepness[f.id] = np.abs(np.cos(direction) * x + np.sin(direction) * y)
    found = probed(*scene(lambda f: -0.04 * steepness[f.id]))
    entry = found.added[0]
    assert entry.probe.name == name
    values = with_intervals(entry.probe, entry.estimate)
    rise_nm = {}
    for one in (along, across):
        table = {name: value for name, (value, _, _) in values.items() if name.startswith(f"along_{one}_")}
        slopes = [float(name.rpartition("_")[2]) for name in table]
        rise_nm[one] = np.polyfit(slopes, list(table.values()), 1)[0]
    # As below: a tenth for the ridge; what is seen across is of the same size at most.
    assert rise_nm[along] == pytest.approx(-40, rel=0.1)
    assert abs(rise_nm[across]) < 4


@pytest.mark.parametrize("count", [SPLINES, PROFILE_SPLINES])
def test_splines_end_where_pixels_are_sampled(count: int) -> None:
    scan = scene()[0][0]
    rows = np.unique(scan.sample // SIZE_PX)
    splines = _over(SIZE_PX, count)
    for beyond in (splines[:, : rows.min()], splines[:, rows.max() + 1 :]):
        assert beyond.shape[1] > 1
        assert np.ptp(beyond, axis=1).max() < 1e-12


@pytest.mark.slow
def test_what_grows_with_the_slope_comes_back_as_a_table_over_the_slope() -> None:
    """A bead of 20 nm per unit slope, on edges of any direction: no effect of the catalogue."""
    scans, predictions = scene()
    steepness = {
        f.id: np.hypot(*np.gradient(p.astype(float), f.stored.pitch_um))
        for f, p in zip(scans, predictions, strict=True)
    }
    found = probed(*scene(lambda f: 0.02 * steepness[f.id]))
    entry = found.added[0]
    assert entry.probe.name == "slope-table"
    values = with_intervals(entry.probe, entry.estimate)
    slopes = np.array([float(name.removeprefix("slope_")) for name in values])
    heights = np.array([value for value, _, _ in values.values()])
    # Each scan's offset is free, so the table is known but for a constant; its rise is 20 nm.
    assert np.polyfit(slopes, heights, 1)[0] == pytest.approx(20, rel=0.1)


@pytest.mark.slow
def test_a_map_that_all_scans_share_is_found_and_drawn() -> None:
    def ripple(scan: PreparedScan) -> np.ndarray:
        y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in scan.stored.shape), indexing="ij")
        return 0.012 * np.sin(3 * x + 1) * np.cos(3.5 * y)

    found = probed(*scene(ripple))
    entry = found.added[0]
    assert entry.probe.name == "position-map"
    planted = ripple(scene()[0][0])[:: SIZE_PX // 32, :: SIZE_PX // 32]
    size = planted.shape[0]
    y, x = np.meshgrid(*(np.linspace(-1, 1, size),) * 2, indexing="ij")
    plane_and_bow = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]).reshape(6, -1).T

    def fine(values: np.ndarray) -> np.ndarray:
        fitted = plane_and_bow @ np.linalg.lstsq(plane_and_bow, values.ravel(), rcond=None)[0]
        return values.ravel() - fitted

    estimate = drawn(entry.estimate.common, size)
    assert np.corrcoef(fine(estimate), fine(planted))[0, 1] > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("along", ["row", "column"])
def test_a_profile_of_the_dose_over_one_axis_is_found_and_drawn(along: str) -> None:
    def wave(count: int, first: float = 0.0) -> np.ndarray:
        # Three periods: finer than a map of 5 splines, coarser than the profile's 24.
        return 0.04 * np.sin(6 * np.pi * np.linspace(first, 1 - first, count) + 0.5)

    _, predictions = scene()
    by_scan = {f.id: p for f, p in zip(scene()[0], predictions, strict=True)}

    def uneven(scan: PreparedScan) -> np.ndarray:
        ny, nx = scan.stored.shape
        profile = wave(ny)[:, None] if along == "row" else wave(nx)[None, :]
        return profile * by_scan[scan.id]

    found = probed(*scene(uneven))
    entry = found.added[0]
    assert entry.probe.name == f"{along}-gain-profile"
    estimate, planted = drawn_profile(entry.estimate.common), wave(201, first=8 / (SIZE_PX - 1))
    # The cubic splines alone leave (π/8)⁴/384 of a wave of 8 knots per period: nothing.
    assert np.corrcoef(estimate, planted)[0, 1] > 0.95
    assert estimate.std() == pytest.approx(planted.std(), rel=0.15)


@pytest.mark.parametrize("along", ["row", "column"])
def test_where_the_print_lies_over_one_axis_is_found_and_drawn(along: str) -> None:
    """A stage that wanders by 0.08 µm along the axis that it steps along, in every print alike."""

    def wave_um(count: int, first: float = 0.0) -> np.ndarray:
        return 0.08 * np.sin(6 * np.pi * np.linspace(first, 1 - first, count) + 0.5)

    def fine(values: np.ndarray) -> np.ndarray:
        """Freed of what the warp of a scan may have: a parabola along the axis."""
        at = np.linspace(-1, 1, len(values))
        return values - np.polyval(np.polyfit(at, values, 2), at)

    scans, predictions = scene()
    by_scan = {f.id: p for f, p in zip(scans, predictions, strict=True)}
    axis = 0 if along == "row" else 1

    def moved(scan: PreparedScan) -> np.ndarray:
        at = np.indices(scan.stored.shape, dtype=float)
        at[axis] -= np.moveaxis(np.broadcast_to(wave_um(SIZE_PX), scan.stored.shape), 1, axis) / 0.1
        print_um = by_scan[scan.id].astype(float)
        return map_coordinates(print_um, at, order=3, mode="nearest") - print_um

    scans, _ = scene(moved)
    [probe] = generic_terms(scans, predictions, find_defects(scans, predictions), [f"{along}-shift-profile"])
    estimate = probe.held_out(FOLD_OF)
    parts_um = [fine(drawn_profile(one)) for one in shifts(estimate.common)]
    planted_um = fine(wave_um(201, 8 / (SIZE_PX - 1)))
    # Slopes change within a step of 0.08 µm: a first-order estimate is short by some part of it.
    assert np.corrcoef(parts_um[axis], planted_um)[0, 1] > 0.95
    assert parts_um[axis].std() == pytest.approx(planted_um.std(), rel=0.25)
    # Across it nothing moves.
    assert parts_um[1 - axis].std() < 0.1 * planted_um.std()
    assert estimate.mean_gain_nm2 > 0
    drawing: Any = SimpleNamespace(probe=probe, estimate=estimate)
    assert probe_figure(drawing).axes


def test_blobs_are_found_and_their_place_is_told() -> None:
    """Blobs of 8 robust standard deviations: EFFECTS asks for a recall of 0.9."""
    spots = [(20, 30), (60, 80), (80, 40)]

    def blobs(scan: PreparedScan) -> np.ndarray:
        change = np.zeros(scan.stored.shape)
        for y, x in spots:
            change[y - 2 : y + 3, x - 2 : x + 3] = 8 * NOISE_UM * (1 if y != 60 else -1)
        return change

    scans, predictions = scene(blobs)
    found = find_defects(scans, predictions)
    first = [b for b in found.blobs if b.scan == scans[0].id]
    near = [
        min((abs(b.y_um - y / 10) + abs(b.x_um - x / 10) for b in first), default=9.0) < 0.2 for y, x in spots
    ]
    assert sum(near) == len(spots)
    assert len(found.blobs) >= 0.9 * len(spots) * COUNT
    assert {np.sign(b.peak_nm) for b in first} == {-1.0, 1.0}
    assert not any(b.row_limited for b in first)
    clean_fields, clean_predictions = scene()
    assert not find_defects(clean_fields, clean_predictions).blobs


def test_a_step_in_the_order_of_printing_is_told_from_none() -> None:
    later = {f.id for f in scene()[0][6:]}
    scans, predictions = scene(lambda f: np.full(f.stored.shape, 0.06 * (f.id in later)))
    offset, gain = order_trends(scans, predictions)
    assert offset.step_p < 0.05
    assert offset.step_after == scans[5].id
    # Ten datums of 20 nm: the two means differ by 20 sqrt(1/6 + 1/4) = 13 nm, three of which are allowed.
    assert offset.step == pytest.approx(60, abs=39)
    assert gain.step_p > 0.05
    mean, _, step = offset.left_out
    assert step < mean


def test_a_kernel_filters_alike_at_any_sampling() -> None:
    coarse = np.zeros((64, 64))
    coarse[3, 60] = 0.02
    coarse = gaussian_filter(coarse, 1.0, mode="wrap")
    fine = resampled(coarse, 0.2, 0.1)
    assert fine.sum() == pytest.approx(coarse.sum(), rel=1e-3)
    y, x, _ = off_centre_peak(coarse, 0.2)
    assert (y, x) == pytest.approx((0.6, -0.8), abs=0.05)
