"""Check that a scanner bend is found, stored and replayed, and that none is found in a straight scan."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from litho_data.exchange.release import export_zip
from litho_data.level import layout_in_scan_frame
from litho_data.making.build import build_dataset
from litho_data.provenance.history import read_steps, replay
from litho_data.provenance.verify import verify
from litho_data.register import Bend, Registration, apply_transform, register_scan, resample_to_layout
from litho_data.register.bend import fit_bent_affine
from litho_data.register.geometry import index_to_um, orient, orientation_matrix
from litho_data.register.quality import judge
from litho_data.store import open_store
from litho_data.virtual_fab import KnobSetting, Truth, simulate
from litho_data.virtual_fab.canvas import GUARD_PX
from litho_data.virtual_fab.geometry import ScanFrame, sample_surface
from litho_data.virtual_fab.knobs import KnobBoard
from tests.litho_data.register_phantoms import (
    LEVEL_HEIGHT_UM,
    PITCH_UM,
    PRINT_BLUR_PX,
    random_layout,
    warp_about_centre,
)
from tests.litho_data.test_register_quality import GOOD

SHAPE, SCAN_SHAPE = (256, 280), (312, 344)
AMOUNT_UM = np.array([[0.66, -0.45, 0.54], [-0.6, 0.72, 0.39]])
# The limit is the same as for a straight scan. At SNR 5, white noise alone displaces a corner by about
# 0.025 px if the warp is affine, and (26 / 7)**0.5 times as far if it has twelve parameters: there the
# squares of the basis functions, of unit mean square, add up to 1 + 3 + 3 for an affine warp. The quadratic
# ones add 5 + 9 + 5.
CORNER_PX = 0.3
PITCHES = {"scan_pitch_um": (PITCH_UM, PITCH_UM), "layout_pitch_um": PITCH_UM}


def bend_of(factor: float = 1.0, shape: tuple[int, int] = SCAN_SHAPE) -> Bend:
    return Bend.of_scan(factor * AMOUNT_UM, shape, (PITCH_UM, PITCH_UM))


def true_map() -> np.ndarray:
    """Return the true matrix from the straightened scan to the layout, in µm."""
    frame = index_to_um((PITCH_UM, PITCH_UM))
    warp = warp_about_centre(SHAPE, rotation_deg=0.8, scale=(1.01, 0.99), margin_px=(32.0, 28.0))
    return frame @ np.linalg.inv(warp) @ np.linalg.inv(frame)


def places_um(shape: tuple[int, int]) -> np.ndarray:
    """Return the positions (x, y) in µm of all pixel centres of a scan, row by row."""
    y, x = (PITCH_UM * (one.ravel() + 0.5) for one in np.indices(shape))
    return np.stack([x, y], axis=1)


def bent_scan(layout: np.ndarray, bend: Bend, snr: float = 5.0) -> np.ndarray:
    """Return a bent scan: the blurred print at the true place of each pixel, plus white noise."""
    print_um = LEVEL_HEIGHT_UM * gaussian_filter(layout.astype(float), PRINT_BLUR_PX, mode="constant")
    x, y = apply_transform(true_map(), bend.straighten(places_um(SCAN_SHAPE))).T / PITCH_UM - 0.5
    scan = map_coordinates(print_um, (y, x), order=5, mode="constant").reshape(SCAN_SHAPE)
    return scan + np.random.default_rng(0).standard_normal(SCAN_SHAPE) * print_um.std() / snr


def register(scan: np.ndarray, layout: np.ndarray, **options) -> Registration:
    return register_scan(scan, layout, **PITCHES, **options)


@cache
def registered(back: str, factor: float, model: str) -> Registration:
    """Register a bent scan after it was turned by ``back``."""
    layout = random_layout(SHAPE, seed=2)
    scan = orient(bent_scan(layout, bend_of(factor)), back)
    return register(np.ascontiguousarray(scan), layout, model=model)


def layout_places_um(found: Registration, points_um: np.ndarray) -> np.ndarray:
    bend = found.bend_um
    return apply_transform(found.scan_to_layout, points_um if bend is None else bend.straighten(points_um))


@pytest.mark.parametrize(
    ("orientation", "factor", "model"),
    [("identity", 1.0, "affine"), ("rotate-90", 2.0, "affine"), ("flip-y", 1.0, "ladder")],
)
def test_a_known_bend_is_recovered_in_any_orientation(orientation, factor, model):
    bend = bend_of(factor)
    back = {"rotate-90": "rotate-270"}.get(orientation, orientation)
    found = registered(back, factor, model)
    assert found.quality.passed, found.quality.reason
    assert found.quality.model == "quadratic"
    assert found.quality.dihedral == orientation
    # For every pixel on the layout, compare the registered place with the true place.
    upright_um = places_um(SCAN_SHAPE)
    truth_um = apply_transform(true_map(), bend.straighten(upright_um))
    turn = orientation_matrix(back, SCAN_SHAPE)
    turned_um = PITCH_UM * (apply_transform(turn, upright_um / PITCH_UM - 0.5) + 0.5)
    seen = ((truth_um > 0) & (truth_um < PITCH_UM * np.array(SHAPE[::-1]))).all(axis=1)
    error_px = np.hypot(*(layout_places_um(found, turned_um) - truth_um)[seen].T) / PITCH_UM
    assert error_px.max() < CORNER_PX
    # The stated uncertainty must be right: no corner is wrong by more than six standard deviations.
    assert error_px.max() < 6 * found.quality.corner_sd_px + 0.02
    # The largest displacement is at the corner of the scan. It is up to (344 / 280)² times as large as that
    # on the layout.
    assert found.bend_um.largest == pytest.approx(bend.largest, abs=CORNER_PX * PITCH_UM * (344 / 280) ** 2)
    assert f"scan bent by up to {found.bend_um.largest:.2f} µm" in found.quality.warning


def test_a_straight_warp_of_a_bent_scan_exceeds_its_limits():
    # If the user chooses a stiffer model, no bend is fitted, and the residual remains.
    stiff = registered("identity", 1.0, "similarity")
    assert stiff.bend_um is None
    assert "target registration error" in stiff.quality.reason
    # A scan passes if the error is below 1.5 px. At SNR 5, block shifts are known to 0.1 px.
    bent = registered("identity", 1.0, "affine")
    assert bent.quality.tre_median_px < 0.3 < 1.5 < stiff.quality.tre_median_px


def test_a_straight_scan_is_not_bent():
    layout = random_layout(SHAPE, seed=3, blob_px=7.0)
    found = register(bent_scan(layout, bend_of(0.0)), layout)
    assert (found.quality.passed, found.quality.warning, found.quality.model) == (True, "", "affine")
    assert found.bend_um is None


def test_a_bend_within_the_limits_of_a_straight_warp_is_not_fitted():
    # The bend is at most 0.15 µm, or 1.5 px, at a corner, and smaller elsewhere, so an affine warp passes.
    layout = random_layout(SHAPE, seed=3)
    found = register(bent_scan(layout, bend_of(0.1)), layout)
    assert bend_of(0.1).largest < 0.16
    assert found.quality.passed
    assert found.bend_um is None


@pytest.mark.parametrize("case", ["layout of another", "noise", "grating", "wrong pitch"])
def test_no_bend_makes_a_wrong_scan_pass(case):
    layout = random_layout(SHAPE, seed=4, blob_px=12.0)
    scan = bent_scan(layout, bend_of(), snr=20)
    pitches = dict(PITCHES)
    if case == "layout of another":
        layout = random_layout(SHAPE, seed=5, blob_px=12.0)
    elif case == "noise":
        scan = gaussian_filter(np.random.default_rng(1).standard_normal(SCAN_SHAPE), 3)
    elif case == "grating":
        layout = np.broadcast_to(6 * (np.arange(SHAPE[1]) % 24 < 12), SHAPE).astype(np.uint8)
        scan = bent_scan(layout, bend_of())
    else:
        pitches["scan_pitch_um"] = (0.1, 0.125)
    found = register_scan(scan, layout, **pitches)
    assert not found.quality.passed
    assert found.bend_um is None
    assert found.quality.reason


def test_a_bend_that_may_fold_the_scan_is_refused():
    # d(shift)/dx is 2 a u / half, so at u = 1 it reaches 1 for a = half / 2.
    half_um = bend_of().half[0]
    for share, passed in ((0.99, True), (1.01, False)):
        bend = Bend(np.array([[share * half_um / 2, 0, 0], [0, 0, 0]]), bend_of().middle, bend_of().half)
        assert bend.slope == pytest.approx(share, rel=1e-12)
        assert judge(GOOD, 2.0, bend)[0] is passed


def test_undo_is_the_inverse_of_straighten_up_to_the_fold():
    unit = np.random.default_rng(6).uniform(-1, 1, (500, 2))
    bend = bend_of(5.0)
    assert 0.5 < bend.slope < 1
    points = bend.middle + bend.half * unit
    back = np.stack(bend.undo(*bend.straighten(points).T), axis=1)
    # The iteration ends at a step below 1e-9 half widths, or 2e-8 µm. Each step is at most 0.84 of the last.
    np.testing.assert_allclose(back, points, atol=2e-7)


def test_a_bend_is_centred_converts_to_pixels_and_is_fitted_from_points():
    bend = bend_of()
    # The terms are orthogonal to 1, u and v over the frame, so a dense average contains no affine part.
    u, v = np.meshgrid(*[(np.arange(400) + 0.5) / 200 - 1] * 2)
    shift = np.array(bend.shift(bend.middle[0] + bend.half[0] * u, bend.middle[1] + bend.half[1] * v))
    for basis in (np.ones_like(u), u, v):
        # The midpoint rule with 400 cells is wrong by 1 / (3 · 400²) = 2.1e-6 for the mean of u². The
        # coefficients of u² and v² add up to at most 1.2 µm.
        np.testing.assert_allclose((shift * basis).mean(axis=(1, 2)), 0, atol=2.6e-6)
    points = places_um((40, 50)) * 6
    in_pixels = bend.in_pixels((PITCH_UM, PITCH_UM)).straighten(points / PITCH_UM - 0.5)
    np.testing.assert_allclose(PITCH_UM * (in_pixels + 0.5), bend.straighten(points), atol=1e-12)
    images = apply_transform(true_map(), bend.straighten(points))
    matrix, found = fit_bent_affine(points, images, bend.middle, bend.half)
    np.testing.assert_allclose(matrix, true_map(), atol=1e-10)
    np.testing.assert_allclose(found.amount, bend.amount, atol=1e-10)


def test_points_on_a_line_do_not_determine_a_bend():
    bend = bend_of()
    on_a_line = bend.middle + np.linspace(-1, 1, 9)[:, None] * bend.half
    with pytest.raises(np.linalg.LinAlgError):
        fit_bent_affine(on_a_line, on_a_line, bend.middle, bend.half)


def test_resampling_reads_the_scan_at_the_bent_place():
    # A cubic spline reproduces a ramp, so the resampled height shows which place of the scan was read.
    y_um, x_um = (one.reshape(SCAN_SHAPE) for one in places_um(SCAN_SHAPE).T[::-1])
    bend, origin_um = bend_of(), true_map()
    taken = [resample_to_layout(ramp, origin_um, SHAPE, **PITCHES, bend_um=bend)[0] for ramp in (x_um, y_um)]
    landed_um = apply_transform(origin_um, bend.straighten(np.stack([one.ravel() for one in taken], axis=1)))
    inner = np.pad(np.ones((SHAPE[0] - 40, SHAPE[1] - 40), bool), 20).ravel()
    # A float32 of 40 µm is exact to 4e-6 µm.
    np.testing.assert_allclose(landed_um[inner], places_um(SHAPE)[inner], atol=1e-5)


def test_the_layout_under_a_bent_scan_is_the_layout_where_it_really_was():
    layout = random_layout(SHAPE, seed=7)
    pitch_um = (PITCH_UM, PITCH_UM)
    level = layout_in_scan_frame(layout, true_map(), SCAN_SHAPE, pitch_um, PITCH_UM, bend_of())
    column, row = np.floor(
        apply_transform(true_map(), bend_of().straighten(places_um(SCAN_SHAPE))).T / PITCH_UM
    ).astype(int)
    inside = (row >= 0) & (row < SHAPE[0]) & (column >= 0) & (column < SHAPE[1])
    assert np.isnan(level.ravel()[~inside]).all()
    np.testing.assert_array_equal(level.ravel()[inside], layout[row[inside], column[inside]])


def test_a_bent_campaign_is_built_verified_and_replayed_from_its_raw_files(
    tmp_path: Path, without_report: None
):
    strength_um = 0.4
    knobs = [KnobSetting("registration-residual", strength_um)]
    card = simulate(tmp_path / "fab", count=1, size_px=256, seed=5, knobs=knobs)
    result = build_dataset(card, tmp_path / "bent.zarr", strict=True)
    store = open_store(tmp_path / "bent.zarr")
    assert (result.n_scans, len(store)) == (1, 1)
    truth = Truth.read(tmp_path / "fab" / "truth")
    board = KnobBoard(knobs, truth.seed)
    y_px, x_px = np.indices([n + 2 * GUARD_PX for n in (256, 256)]) - float(GUARD_PX)
    for index, scan in enumerate(store.scans()):
        row = store.quality.set_index("scan").loc[scan.id]
        assert f"scan bent by up to {row['bend_um']:.2f} µm" in row["warning"]
        assert scan.bend_um is not None
        np.testing.assert_array_equal(scan.bend_um.amount[0, 0], row["bend_x_by_xx_um"])
        shape = store.scan_frame(scan.id, "raw_height_um").shape
        frame = ScanFrame(shape, 0.1, np.array(truth.scans[index].scan_to_layout), 0.1)
        # The fab scans ramps, which give the true place of each pixel.
        true_px = np.stack([sample_surface(r, frame, board, index).ravel() for r in (x_px, y_px)], axis=1)
        found_um = apply_transform(scan.scan_to_layout, scan.bend_um.straighten(places_um(shape)))
        seen = ((true_px > 0) & (true_px < 255)).all(axis=1)
        error_px = np.hypot(*(found_um / 0.1 - 0.5 - true_px)[seen].T)
        assert error_px.max() < 6 * row["corner_sd_px"] + 0.02
        # A scan passes below 1.5 px at the worst corner. The rms over the field is below a third of that.
        assert np.sqrt((error_px**2).mean()) < 0.5
        assert row["tre_median_px"] < 1.0
    step = {one.op: one for _, one in read_steps(store)[store.ids[0]]}
    assert [one["name"] for one in step["register"].outputs] == ["scan_to_layout", "bend_um"]
    assert "bend_um" in {one["name"] for one in step["resample"].inputs}
    assert verify(tmp_path / "bent.zarr").findings == ()
    again = replay(tmp_path / "bent.zarr", [store.ids[0]])
    assert again["same_hash"].all()
    assert "bend_um" in set(again["array"])
    packed = open_store(export_zip(tmp_path / "bent.zarr", tmp_path / "bent.zarr.zip"))
    assert packed.computed_sha256() == store.sha256
    np.testing.assert_array_equal(
        packed.scan(store.ids[0]).bend_um.amount, store.scan(store.ids[0]).bend_um.amount
    )
