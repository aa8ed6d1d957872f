"""Test the uncertainty of heights: its parts against closed forms, and the whole on prints whose surface is
known.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import zarr
from scipy.ndimage import gaussian_filter

from litho_data import open_store
from litho_data.making.build import build_dataset
from litho_data.making.height_sigma import height_sigma
from litho_data.provenance.history import replay
from litho_data.register.flows import LADDER, normalisation
from litho_data.register.pyramid import SCAN_BLUR_PX
from litho_data.register.refine import NUISANCES, aligned_gram, solve_gram
from litho_data.register.resample import resample_to_layout, transfer_error
from litho_data.register.topography import predicted_topography, quadratic_basis
from litho_data.register.warp_error import WarpError, warp_error
from litho_data.roughness import white_noise
from litho_data.store.write import consolidate
from litho_data.virtual_fab.simulate import simulate
from tests.litho_data.campaigns import layout_of


def _print(seed: int, size: int) -> np.ndarray:
    """Return a print with an rms height of 0.5 µm. It is blurred as if by a spot of 0.25 µm on a grid of 0.1
    µm.
    """
    white = np.random.default_rng(seed).standard_normal((size, size))
    return 0.5 * gaussian_filter(white, 2.5) / gaussian_filter(white, 2.5).std()


@pytest.mark.parametrize("fast_axis", ["x", "y"])
def test_noise_of_pixels_and_lines_is_told_from_a_print(fast_axis):
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        noise_nm = 0.8 * rng.standard_normal((256, 256)) + 3.0 * rng.standard_normal((256, 1))
        height = _print(seed, 256) + 1e-3 * (noise_nm if fast_axis == "x" else noise_nm.T)
        height[100:110, 30:60] = np.nan
        found.append(white_noise(height, fast_axis=fast_axis))
    pixel_nm, line_nm = np.mean(found, axis=0)
    # The eighth-order differences of n values are worth n / 3.63 independent ones (the sum of their squared
    # correlations), and the median deviation has an efficiency of 0.37. The standard error for one scan of
    # 240 x 240 pixels is 0.7 %, and 14 % for its 240 lines. For six scans these are 0.3 % and 6 %. The limits
    # allow three times that. The print adds less than 1 % of the pixel noise.
    assert pixel_nm == pytest.approx(0.8, rel=0.02)
    assert line_nm == pytest.approx(3.0, rel=0.18)


def test_the_noise_is_unknown_where_gaps_leave_too_few_neighbouring_pixels():
    height = _print(0, 64)
    height[::5, ::5] = np.nan
    assert np.isnan(white_noise(height)).all()


@pytest.mark.parametrize(("lines", "known"), [(16, False), (17, True)])
def test_the_line_noise_of_too_few_lines_is_unknown_and_not_zero(lines, known):
    rng = np.random.default_rng(0)
    noise_nm = 0.8 * rng.standard_normal((lines, 200)) + 3.0 * rng.standard_normal((lines, 1))
    assert np.isfinite(white_noise(1e-3 * noise_nm)).tolist() == [True, known]
    assert np.isfinite(white_noise(1e-3 * noise_nm.T, fast_axis="y")).tolist() == [True, known]


@pytest.mark.parametrize("frequency", [0.15, 0.3, 0.4])
def test_the_stated_loss_of_resampling_is_that_of_a_resampled_wave(frequency):
    x_px = np.arange(400)
    wave = np.broadcast_to(np.cos(2 * np.pi * frequency * x_px), (8, 400)).astype(np.float64)
    # The scale differs by one part in 350, so that all sub-pixel positions are equally frequent.
    matrix = np.diag([1 + 1 / 350, 1.0, 1.0])
    out, valid = resample_to_layout(wave, matrix, (8, 380), scan_pitch_um=(0.1, 0.1), layout_pitch_um=0.1)
    at_px = (np.arange(380) + 0.5) / (1 + 1 / 350) - 0.5
    error = (out - np.cos(2 * np.pi * frequency * at_px))[4, 20:370]
    assert valid[4, 20:370].all()
    known, loss = transfer_error(0.1, 0.1)
    # A real wave of amplitude 1 has half the power of a complex one. Aliases beat over the 350 samples.
    assert (error**2).mean() == pytest.approx(np.interp(10 * frequency, known, loss) / 2, rel=0.1)


def test_an_uncertain_warp_moves_a_plane_by_its_slope():
    """Check a plane with slopes p and q. Its shifts along x and y have the uncertainties a and b, and its
    rotation has the uncertainty c.

    The variance of its height is (pa)² + (qb)² + c²(qx − py)².
    """
    shape, (a, b, c), (p, q) = (40, 60), (0.01, 0.02, 0.005), (0.3, -0.2)
    y, x = np.mgrid[:40, :60].astype(float)
    scale = normalisation(shape)[0, 0]
    error = WarpError(np.diag([a, b, c]) ** 2, 0.0, 0.0, False)
    # Amounts refer to the normalised frame, where a shift of a means a / scale pixels.
    known = ((p * a) ** 2 + (q * b) ** 2) / scale**2 + c**2 * (q * (x - 29.5) - p * (y - 19.5)) ** 2
    np.testing.assert_allclose(error.warp_variance(p * x + q * y), known, rtol=1e-9)


def test_the_spread_of_fitted_warps_equals_the_stated_uncertainty():
    """Check the spread of fits to prints of one layout whose errors are correlated over 4 px."""
    layout = layout_of(3, (256, 256))
    stated, moved = [], []
    topography = 0.05 * gaussian_filter(layout.astype(float), 2.0)
    for seed in range(12):
        white = gaussian_filter(np.random.default_rng(seed).standard_normal((256, 256)), 4.0)
        height = topography + 0.02 * white / white.std()
        stated.append(np.diag(warp_error(height, layout, 2.0, "affine").covariance))
        smooth, predicted = gaussian_filter(height, SCAN_BLUR_PX), predicted_topography(layout, 2.0)
        coefficients = solve_gram(aligned_gram(smooth, predicted, LADDER["affine"]).sum(axis=(0, 1)))
        moved.append(coefficients[NUISANCES:] / coefficients[0])
    # There are 12 draws of 6 amounts. If the stated variances are right, the mean square of the amounts
    # divided by its stated value is 1 ± 0.17. Using 16 blocks for 13 numbers may add an error of a third.
    ratio = np.sqrt(np.mean(np.square(moved), axis=0) / np.mean(stated, axis=0))
    assert 0.7 < np.sqrt((ratio**2).mean()) < 1.4


@pytest.mark.parametrize(("size", "sees_the_border"), [(416, True), (256, False)])
def test_the_error_of_the_magnification_includes_the_pull_of_a_displaced_border(size, sees_the_border):
    """Check a print whose only error is that its outermost 32 px are displaced outwards by 0.1 px."""
    layout = layout_of(3, (size, size))
    topography = predicted_topography(layout, 2.0)
    y, x = np.indices(topography.shape) - (size - 1) / 2
    gradient_y, gradient_x = np.gradient(topography)
    outwards = (abs(x) > size / 2 - 32) * np.sign(x) * gradient_x + (abs(y) > size / 2 - 32) * np.sign(
        y
    ) * gradient_y
    height = topography - 0.1 * outwards
    found = solve_gram(aligned_gram(height, topography, LADDER["affine"]).sum(axis=(0, 1)))
    pull, stated = found[NUISANCES + 3] / found[0], warp_error(height, layout, 2.0, "affine").covariance[3, 3]
    # Inner cells show no displacement, apart from the smoothing across their edges. The jackknife notices
    # that blocks differ, but states less than half of the error.
    assert (stated**0.5 > 0.9 * abs(pull)) == sees_the_border
    assert stated**0.5 < 1.5 * abs(pull)


def test_the_variance_of_a_fit_is_subtracted_from_a_seen_surface_and_added_to_a_levelled_one():
    assert WarpError(np.eye(6), 5.0, 3.0, True).surface_variance(levelled=False) == pytest.approx(16)
    assert WarpError(np.eye(6), 5.0, 3.0, False).surface_variance(levelled=True) == pytest.approx(34)
    assert WarpError(np.eye(6), 5.0, 3.0, False).surface_variance(levelled=False) == 0
    assert WarpError(np.eye(6), 3.0, 5.0, True).surface_variance(levelled=False) == 0


def test_random_tilt_and_bow_scatter_the_share_of_pixels_within_one_sigma():
    """Check random sums of five tilt and bow terms of equal rms, where σ is the rms of each sum."""
    basis = quadratic_basis((48, 48))[1:].reshape(5, -1)
    basis = (basis - basis.mean(axis=1, keepdims=True)) / basis.std(axis=1, keepdims=True)
    surfaces = np.random.default_rng(0).standard_normal((6000, 5)) @ basis
    errors = np.abs(surfaces / surfaces.std(axis=1, keepdims=True))
    within_1, within_196 = ((errors < limit).mean(axis=1) for limit in (1.0, 1.96))
    # The two shares scatter by 0.048 and 0.012 between scans, so the means of 6000 scatter by 0.0006 and
    # 0.0002. The spread 0.0107 between 300 sets of 20 is known to one part in 24. The limits allow three
    # times these errors, plus the error due to only 48 pixels a side.
    assert within_1.mean() == pytest.approx(0.696, abs=0.004)
    assert within_196.mean() == pytest.approx(0.946, abs=0.002)
    assert within_1.reshape(300, 20).mean(axis=1).std() == pytest.approx(0.0107, rel=0.13)


def test_the_surface_that_levelling_removes_from_a_print_is_as_large_as_stated():
    """Check the size of the surface that least squares removes from topography and roughness.

    It is estimated from the levelled heights and the topography alone.
    """
    layout = layout_of(3, (256, 256))
    topography = 0.05 * gaussian_filter(layout.astype(float), 2.0)
    basis = quadratic_basis((256, 256)).reshape(6, -1)
    stated, taken = [], []
    for seed in range(12):
        white = gaussian_filter(np.random.default_rng(seed).standard_normal((256, 256)), 8.0)
        height = topography + 0.02 * white / white.std()
        surface = (np.linalg.lstsq(basis.T, height.ravel(), rcond=None)[0] @ basis).reshape(height.shape)
        stated.append(1e6 * warp_error(height - surface, layout, 2.0, "affine").surface_variance(True))
        taken.append(1e6 * surface.var())
    # The surface of the topography has a variance of 76 nm², and noise of 20 nm correlated over 16 pixels
    # adds 30 nm². The error is 30 nm² for single scans and 9 nm² for the mean of 12; three times that is
    # allowed. A jackknife of 16 blocks may also be wrong by a third. Without the error of the fit, the result
    # would be 35 nm² too small.
    assert np.mean(stated) - np.mean(taken) == pytest.approx(0, abs=30)


def test_a_height_that_depends_on_the_surroundings_is_not_taken_for_tilt_or_bow():
    """Check a print without tilt or bow that is higher where more is printed within 2 µm."""
    layout = layout_of(3, (256, 256))
    topography = 0.05 * gaussian_filter(layout.astype(float), 2.0)
    white = 0.005 * np.random.default_rng(0).standard_normal((256, 256))
    around = gaussian_filter(topography, 20.0, mode="nearest")
    found = warp_error(topography + 0.2 * around + white, layout, 2.0, "affine")
    # A fit without the surroundings would report a surface of 3.1 nm.
    assert 1e3 * found.surface_rms < 1.5
    assert not found.is_clear


def test_an_error_surface_counts_only_if_it_is_significant_or_the_scan_was_levelled():
    layout = layout_of(2, (256, 256))
    x = np.linspace(-1, 1, 256)
    white = 0.02 * np.random.default_rng(0).standard_normal((256, 256))
    settings = {"scan_pitch_um": (0.1, 0.1), "layout_pitch_um": 0.1, "blur_px": 2.0, "model": "affine"}

    def budget(tilt_um: float, levelled: bool) -> float:
        height = 0.05 * gaussian_filter(layout.astype(float), 2.0) + white + tilt_um * x
        _, parts = height_sigma(height, height, layout, levelled=levelled, **settings)
        return parts["sigma_levelling_nm"]

    assert budget(0.0, False) == 0
    assert 0 < budget(0.0, True) < 2
    # A tilt of 0.05 µm over half the field has an rms of 0.05 µm / √3.
    assert budget(0.05, False) == pytest.approx(1e3 * 0.05 / 3**0.5, rel=0.05)


def test_errors_of_virtual_prints_are_as_large_as_stated(tmp_path, without_report):
    """Compare σ with the error. This is the stored height minus the true rough surface, with the mean of this
    difference subtracted.
    """
    card = simulate(tmp_path / "fab", count=3, size_px=192, seed=20271, knobs=["scan-line-stripes=8"])
    build_dataset(card, tmp_path / "prints.zarr", workers=1)
    ratios = []
    for scan in open_store(tmp_path / "prints.zarr").scans():
        surface_um = np.load(tmp_path / "fab" / "truth" / "surfaces" / f"{scan.id}.npy")
        error_um = (scan.height_um - surface_um)[scan.valid].astype(np.float64)
        ratios.append((error_um - error_um.mean()) / scan.height_sigma_um[scan.valid])
    pooled = np.concatenate(ratios)
    # Most of σ is line noise of 8 nm. Its square is known to 13 % from 3 x 200 rows, estimated as above. The
    # warp of a field of 19 µm is determined by few features. Together, this may change the ratio by 15 %.
    assert np.sqrt((pooled**2).mean()) == pytest.approx(1, abs=0.15)
    assert (np.abs(pooled) < 1).mean() == pytest.approx(0.683, abs=0.08)
    assert (np.abs(pooled) < 1.96).mean() == pytest.approx(0.95, abs=0.05)


def test_every_valid_height_has_its_uncertainty(campaign: Path) -> None:
    store = open_store(campaign / "prints.zarr")
    for scan in store.scans():
        assert scan.height_sigma_um is not None
        np.testing.assert_array_equal(np.isfinite(scan.height_sigma_um), scan.valid)
    parts = [name for name in store.quality if name.startswith("sigma_") and name != "sigma_nm"]
    total = np.sqrt((store.quality[parts] ** 2).sum(axis=1))
    np.testing.assert_allclose(total, store.quality["sigma_nm"], rtol=1e-9)
    table = replay(campaign / "prints.zarr", ["P11"], arrays=["height_sigma_um"])
    assert table["same_hash"].tolist() == [True]
    for name in ("quality", "summary", "uncertainty"):
        table = pd.read_csv(campaign / "prints-report" / f"{name}.csv", keep_default_na=False, na_values=[])
        wanted = store.quality[[*table]].fillna("")
        pd.testing.assert_frame_equal(table, wanted, check_dtype=False, obj=name)


def test_a_store_without_uncertainty_opens_and_has_the_same_hash(own_campaign: Path) -> None:
    path = own_campaign / "prints.zarr"
    known = open_store(path).sha256
    shutil.rmtree(path / "height_sigma_um")
    consolidate(zarr.open_group(path, mode="a"))
    store = open_store(path)
    assert store.scans()[0].height_sigma_um is None
    assert store.computed_sha256() == known
