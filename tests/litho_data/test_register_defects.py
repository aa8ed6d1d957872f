"""Check that defects of prints are located and reported, and that creep of scan lines is corrected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from litho_data.making.build import build_dataset
from litho_data.making.operations import OPERATIONS, load_recipe
from litho_data.provenance.history import replay
from litho_data.provenance.verify import verify
from litho_data.register import apply_transform
from litho_data.register.bend import CREEP_DEGREE, Bend, fit_bent_affine
from litho_data.register.geometry import index_to_um
from litho_data.store import open_store
from tests.litho_data.campaigns import NOISE_UM, height_of, layout_of, write_campaign, write_scan
from tests.litho_data.register_phantoms import (
    DEFECTS,
    PITCH_UM,
    SCAN_SHAPE,
    SHAPE,
    creeping,
    print_of,
    register,
    rms_error_px,
    scan_of,
    true_scan_to_layout,
)


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_does_not_pull_the_warp_and_is_mapped(name: str) -> None:
    layout, warp = print_of(seed=2)
    clean = scan_of(layout, warp, SCAN_SHAPE, snr=10, seed=2)
    spoiled = DEFECTS[name](clean, np.random.default_rng(9))
    found = register(spoiled, layout)
    assert found.quality.passed, found.quality.reason
    # This is the required accuracy. A fit that ignores defects is wrong by 0.5 to 1.2 px.
    assert rms_error_px(found, warp) < 0.1
    assert found.defects is not None
    assert "does not show the print" in found.quality.warning
    # The map contains the added defect, except where it changes the print by less than the misfit.
    truth = true_scan_to_layout(warp, "identity", SCAN_SHAPE)
    frame = index_to_um((PITCH_UM, PITCH_UM))
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    points = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
    at = apply_transform(np.linalg.inv(frame) @ np.linalg.inv(truth) @ frame, points).T[::-1]
    changed = map_coordinates(np.abs(spoiled - clean), at, order=1).reshape(SHAPE) > 0.3
    inner = (slice(12, -12),) * 2
    assert found.defects[inner][changed[inner]].mean() > 0.97
    assert found.defects.mean() < changed.mean() + 0.12


@pytest.mark.parametrize("snr", [5, np.inf])
def test_a_clean_print_has_no_defects_and_keeps_its_warp(snr: float) -> None:
    layout, warp = print_of(seed=1)
    found = register(scan_of(layout, warp, SCAN_SHAPE, snr=snr, seed=1), layout)
    assert (found.defects, found.bend_um, found.quality.defect_share) == (None, None, 0)
    # At SNR 5, white noise moves the warp by an rms of 0.02 px.
    assert rms_error_px(found, warp) < 0.024


@pytest.mark.parametrize(("creep_um", "slow"), [(0.5, 1), (1.5, 0)])
def test_creep_along_the_slow_axis_is_corrected(creep_um: float, slow: int) -> None:
    layout, warp = print_of(seed=3)
    scan, seen = creeping(layout, warp, creep_um, slow)
    found = register(scan, layout, fast_axis="x" if slow else "y")
    assert found.quality.passed, found.quality.reason
    assert found.quality.model == "creep"
    assert "creep along the slow axis" in found.quality.warning
    # This is the required accuracy. A straight warp would be wrong by 0.8 px per µm of creep.
    assert rms_error_px(found, warp, seen) < 0.15
    assert found.quality.tre_median_px < 0.1


def test_a_curve_along_the_fast_axis_is_reported_and_not_corrected() -> None:
    layout, warp = print_of(seed=3)
    scan, _ = creeping(layout, warp, 0.6, slow=0)
    found = register(scan, layout, fast_axis="x")
    assert found.bend_um is None
    assert found.quality.curve_x_px > 0.4


def test_creep_is_determined_by_points_and_undone() -> None:
    """Check that a fit returns the polynomial of degree 6, and that its inverse maps points back."""
    rng = np.random.default_rng(4)
    middle, half = np.array([20.0, 15.0]), np.array([20.0, 15.0])
    bend = Bend(0.05 * rng.standard_normal((2, 11)), middle, half)
    points = middle + half * rng.uniform(-1, 1, (200, 2))
    matrix = np.array([[1.01, 0.02, 3.0], [-0.01, 0.98, -2.0], [0, 0, 1]])
    images = apply_transform(matrix, bend.straighten(points))
    again, found = fit_bent_affine(points, images, middle, half, CREEP_DEGREE)
    np.testing.assert_allclose(again, matrix, atol=1e-10)
    np.testing.assert_allclose(found.amount, bend.amount, atol=1e-10)
    back = np.stack(bend.undo(*bend.straighten(points).T), axis=1)
    np.testing.assert_allclose(back, points, atol=1e-8)
    assert bend.kind == "creep"


def test_a_defect_is_stored_and_not_valid(tmp_path: Path, without_report: None) -> None:
    shape = (224, 224)
    card = write_campaign(tmp_path, count=1, shape=shape)
    height_um = height_of(layout_of(0, shape), 0)
    corner = slice(0, 70)
    height_um[corner, corner] = 0.0
    write_scan(tmp_path / "scans" / "P11.txt", height_um)
    build_dataset(card, tmp_path / "prints.zarr")
    store = open_store(tmp_path / "prints.zarr")
    defect, scan = store.scan_frame("P11", "defect"), store.scan("P11")
    assert defect.shape == scan.valid.shape == shape
    # The missing corner of the scan includes its margin. The border of 8 px is not compared.
    assert defect[12:55, 12:55].mean() > 0.95
    assert not (scan.valid & defect).any()
    assert np.isnan(scan.height_um[defect]).all()
    assert scan.valid[90:, 90:].mean() > 0.9
    assert store.quality["defect_share"][0] == pytest.approx(defect.mean())
    assert verify(tmp_path / "prints.zarr").findings == ()
    again = replay(tmp_path / "prints.zarr", ["P11"])
    assert again["same_hash"].all()
    assert "defect" in set(again["array"])


def test_a_particle_does_not_tilt_the_levelled_scan() -> None:
    layout, clean = layout_of(0), height_of(layout_of(0), 0)
    y, x = np.indices(clean.shape)
    dusty = clean + (np.hypot(y - 98, x - 98) < 7)
    placed = {"scan_pitch_um": [0.1, 0.1], "layout_pitch_um": 0.1, "model": "affine", "seed": 0}
    removed = []
    for height_um in (clean, dusty):
        arrays = {"mask_level": layout, "raw_height_um": height_um.astype(np.float32)}
        arrays |= OPERATIONS["locate"].run(placed, {}, arrays)[1]
        made = OPERATIONS["level"].run({**placed, "recipe": load_recipe(None)}, {}, arrays)[1]
        removed.append(made["removed_um"])
    # A plane fitted to the particle as well would differ by 0.2 µm between opposite corners.
    assert np.ptp(removed[1] - removed[0]) < NOISE_UM
