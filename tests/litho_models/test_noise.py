"""Noise: what was planted comes back, closed forms hold, and nothing is judged on what it was fitted on."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from litho_data.foundation.errors import InputError
from litho_data.store.lock_box import locked_ids
from litho_models.noise.bounds import high_band_sigma_nm, repeated_prints
from litho_models.noise.calibration import Residuals, analyse_spread, conformal_factor
from litho_models.noise.dose import dose_matrix
from litho_models.noise.neighbourhoods import neighbourhood_noise
from litho_models.noise.residuals import disagreement_um
from litho_models.noise.spread_scores import (
    coverage,
    crps,
    half_width,
    negative_log_likelihood,
    normalised_calibration_error,
    sparsification_error,
)
from litho_models.noise.staircase import READABLE_AT, find_edges, step_print
from litho_models.noise.surface import print_noise, surface_noise
from litho_models.noise.variance import COVARIATES, covariate_maps, fit_log_variance, sigma_nm
from tests.litho_models.prints import make_scans, printed_height_um, write_store


@pytest.fixture
def random():
    """Draws of its own for every test, whatever ran before it."""
    return np.random.default_rng(0)


# --- closed forms -------------------------------------------------------------------------------


@pytest.mark.parametrize(("residual", "sigma"), [(0.0, 1.0), (1.3, 0.7), (-4.0, 2.5)])
def test_crps_is_the_integral_that_defines_it(residual, sigma):
    below, _ = quad(lambda t: norm.cdf(t / sigma) ** 2, -40, residual, limit=200)
    above, _ = quad(lambda t: norm.sf(t / sigma) ** 2, residual, 40, limit=200)
    # Quadrature is good to 1e-8.
    assert float(crps(np.array(residual), sigma)) == pytest.approx(below + above, abs=1e-6)


def test_crps_becomes_the_absolute_error_without_spread():
    residual = np.array([-3.0, 0.5, 8.0])
    assert np.allclose(crps(residual, 1e-9), np.abs(residual), atol=1e-8)


def test_the_scores_are_best_at_the_true_spread(random):
    residual = random.normal(0, 3.0, 40_000)
    for score in (negative_log_likelihood, crps):
        at = [score(residual, sigma).mean() for sigma in (2.4, 3.0, 3.6)]
        assert at[1] < at[0]
        assert at[1] < at[2]
    # Entropy of a Gaussian: ln σ + ½ ln 2πe; the mean of 40,000 z²/2 has sd 1/√(2·40,000) = 0.0035.
    entropy = np.log(3.0) + 0.5 * np.log(2 * np.pi * np.e)
    assert negative_log_likelihood(residual, 3.0).mean() == pytest.approx(entropy, abs=0.015)


@pytest.mark.parametrize("level", [0.5, 0.8, 0.9, 0.95])
def test_coverage_of_a_gaussian_is_its_level(level, random):
    residual = random.normal(0, 2.0, 100_000)
    # Binomial sd √(p(1 − p)/n) ≤ 0.0016.
    assert coverage(residual, 2.0, level) == pytest.approx(level, abs=0.007)


def test_ence_is_the_relative_error_of_sigma(random):
    sigma = np.repeat([1.0, 2.0, 5.0, 9.0], 1000)
    # Residuals of ± σ have that rms in every bin.
    residual = sigma * random.choice([-1.0, 1.0], sigma.size)
    assert normalised_calibration_error(residual, sigma) == pytest.approx(0, abs=1e-12)
    assert normalised_calibration_error(residual, 2 * sigma) == pytest.approx(0.5)
    assert normalised_calibration_error(residual, sigma / 2) == pytest.approx(1.0)
    # The mean of σ over its four values is right for none: the one bin of a constant hides it.
    constant = np.full(sigma.size, np.sqrt(np.mean(sigma**2)))
    assert normalised_calibration_error(residual, constant) == pytest.approx(0, abs=1e-12)
    # Of a Gaussian the rms of n pixels has the relative sd 1/√(2n), so its mean deviation is 1/√(πn); ten
    # bins of 4,000 know that to a quarter.
    steady = random.uniform(1, 9, 40_000)
    gaussian = steady * random.normal(0, 1, steady.size)
    assert normalised_calibration_error(gaussian, steady) == pytest.approx(
        1 / np.sqrt(4000 * np.pi), abs=1 / np.sqrt(4000 * np.pi)
    )


def test_ause_of_uniform_errors_has_closed_forms(random):
    error = (np.arange(10_000) + 0.5) / 10_000
    residual = random.permutation(error) * random.choice([-1.0, 1.0], error.size)
    size = np.abs(residual)
    # The lowest share q of errors uniform on 0 ... 1 has q times the mean, the highest 2 − q times: areas of
    # 1/2 and 3/2; any order of equal σ has 1. Sums over 10,000 pixels stand for the integrals.
    assert sparsification_error(residual, size) == 0
    assert sparsification_error(residual, np.full(error.size, 3.0)) == pytest.approx(0.5, abs=2e-4)
    assert sparsification_error(residual, 1 / size) == pytest.approx(1.0, abs=2e-4)
    # Units and any growing function of σ do not matter.
    assert sparsification_error(1e3 * residual, size**2) == pytest.approx(0, abs=1e-12)


# --- surfaces -----------------------------------------------------------------------------------


def rough(shape, sigma_um, seed=0, correlation_px=0.0):
    from scipy.ndimage import gaussian_filter

    field = np.random.default_rng(seed).normal(0, 1, shape)
    if correlation_px:
        field = gaussian_filter(field, correlation_px, mode="wrap")
    return sigma_um * field / field.std()


@pytest.mark.parametrize("correlation_px", [0.0, 2.0])
def test_planted_roughness_comes_back_in_quadrature(correlation_px):
    substrate = rough((256, 256), 0.00125, 1)
    flat = rough((256, 256), 0.0159, 2, correlation_px) + rough((256, 256), 0.00125, 3) + 0.6
    below = surface_noise("substrate", substrate, "offset")
    above = surface_noise("flat", flat, "offset")
    found = print_noise(above, below)
    # Fields are scaled to their sample sd; what is left is chance correlation of the two, 1/√n_eff.
    chance = 2 * 15.9 * 1.25 / np.sqrt(above.independent_heights) / 15.9
    assert found.print_nm == pytest.approx(15.9, abs=3 * chance + 1e-6)
    assert above.mae_nm == pytest.approx(np.sqrt(2 / np.pi) * above.sigma_nm, rel=0.05)
    # White: every pixel counts. Blurred by s: ρ = exp(−r²/4s²), so Σρ² = 2πs² pixels make one height.
    # Chance correlation at the lags summed, a quarter of the pixels, adds up to a third.
    wanted = 2 * np.pi * correlation_px**2 if correlation_px else 1.0
    assert 0.95 * wanted < flat.size / above.independent_heights < 1.4 * wanted


def test_the_uncertainty_of_sigma_is_its_scatter():
    found = [surface_noise("s", rough_free(seed), "offset") for seed in range(60)]
    scatter = np.std([one.sigma_nm for one in found], ddof=1)
    stated = np.mean([one.sigma_uncertainty_nm for one in found])
    # The sd of 60 values is known to 9 %.
    assert stated == pytest.approx(scatter, rel=0.3)


def rough_free(seed):
    from scipy.ndimage import gaussian_filter

    field = gaussian_filter(np.random.default_rng(seed).normal(0, 1, (96, 96)), 1.5, mode="wrap")
    return 0.01 * field / (1 / np.sqrt(4 * np.pi * 1.5**2))


def test_a_bow_is_roughness_for_one_background_and_not_for_the_other():
    y, x = np.meshgrid(np.linspace(-1, 1, 128), np.linspace(-1, 1, 128), indexing="ij")
    bowed = rough((128, 128), 0.01) + 0.05 * (x**2 + y) + 2.0
    bowed[:5, :7] = np.nan
    assert surface_noise("bowed", bowed, "offset").sigma_nm > 25
    assert surface_noise("bowed", bowed, "quadratic").sigma_nm == pytest.approx(10, rel=0.02)


def test_a_print_smoother_than_its_substrate_has_no_roughness_of_its_own():
    found = print_noise(
        surface_noise("flat", rough((64, 64), 0.001), "offset"),
        surface_noise("substrate", rough((64, 64), 0.002), "offset"),
    )
    assert found.print_nm is None


# --- steps --------------------------------------------------------------------------------------


def staircase(sigma_um, step_um=0.08, axis="x", tilt_um=0.0, seed=4):
    from scipy.ndimage import gaussian_filter1d

    profile = gaussian_filter1d(np.repeat(np.arange(5) * step_um, 50), 2.5, mode="nearest")
    height = np.broadcast_to(profile, (200, 250)) + np.random.default_rng(seed).normal(
        0, sigma_um, (200, 250)
    )
    height = height + tilt_um * np.linspace(-1, 1, 200)[:, None]
    return height if axis == "x" else height.T


@pytest.mark.parametrize("axis", ["x", "y"])
def test_the_treads_of_a_staircase_are_found(axis):
    found, edges = find_edges(staircase(0.01, axis=axis), 0.1)
    assert found == axis
    # The blur of 2.5 px hides the edge by no more than its width.
    assert np.abs(np.array(edges) - [50, 100, 150, 200]).max() <= 2


def test_step_heights_readability_and_misreading_follow_from_the_noise():
    sigma_um, step_um = 0.016, 0.08
    found = step_print("steps", staircase(sigma_um, step_um, tilt_um=0.03), (0.1, 0.1), 0.1)
    assert len(found.steps) == 4
    assert found.tread_sigma_nm == pytest.approx(16, rel=0.02)
    assert found.resolvable_step_nm == pytest.approx(2 * half_width(0.95) * 16, rel=0.02)
    # White noise: the mean over 10 x 10 pixels has a tenth of the sd; some 280 blocks know it to 4 %.
    assert found.resolvable_step_area_nm == pytest.approx(found.resolvable_step_nm / 10, rel=0.2)
    for step in found.steps:
        assert step.height_nm == pytest.approx(80, abs=4 * step.uncertainty_nm + 0.5)
        assert step.readability == pytest.approx(5, rel=0.05)
        # Φ(−2.5) = 0.6 % of some 7,000 pixels: sd 0.1 %.
        assert step.misread == pytest.approx(norm.cdf(-2.5), abs=0.004)
        assert step.misread_if_gaussian == pytest.approx(norm.cdf(-2.5), abs=0.003)


def test_a_flat_surface_has_no_steps():
    with pytest.raises(InputError, match="no step"):
        find_edges(rough((100, 100), 0.01), 0.1)


# --- dose ---------------------------------------------------------------------------------------


def ladder(dose, sigma_um=0.006, seed=0):
    """Height grows with dose; below 0.8 the low levels leave nothing, above 1.2 the high ones saturate."""
    scan = make_scans(1, size_px=60)[0]
    level = np.broadcast_to(np.repeat(np.arange(9), 40), (60, 360)).astype(np.uint8)
    nominal = level * 0.1
    height = np.clip(dose * nominal, 0, 0.75) if dose > 1.2 else dose * nominal
    height = np.where(nominal <= 0.25, 0, height) if dose < 0.8 else height
    sigma = sigma_um * (1 + 2 * abs(dose - 1.0))
    noise = np.random.default_rng([seed, int(100 * dose)]).normal(0, sigma, level.shape)
    return replace(
        scan,
        id=f"D{dose:g}",
        dose=dose,
        mask_level=level,
        height_um=(height + noise + 0.2).astype(np.float32),
        valid=np.ones(level.shape, bool),
    )


def test_the_dose_matrix_sees_height_roughness_and_lost_steps():
    doses = [0.7, 0.85, 1.0, 1.15, 1.3]
    found, notes = dose_matrix([ladder(dose) for dose in reversed(doses)])
    assert notes == []
    assert [row.dose for row in found.rows] == doses
    under, low, nominal, high, over = found.rows
    # Levels 0, 1 and 2 are one height: two steps lost. 0.75 µm is reached below level 6 (0.78 µm).
    assert (under.lost_low, under.under_exposed, under.over_exposed) == (2, True, False)
    assert (over.lost_high, over.over_exposed, over.under_exposed) == (2, True, False)
    for row in (low, nominal, high):
        assert (row.under_exposed, row.over_exposed) == (False, False)
        # The tilt along the ladder is known from the slopes within 9 treads of 20 x 40 px only: the x of a
        # tread spreads by 20/√12 of 360 px, so 6 nm leave 4.4 nm over the field, 0.6 % of 800 nm.
        assert row.height_gain == pytest.approx(row.dose, abs=0.02)
        assert row.roughness_nm == pytest.approx(6 * (1 + 2 * abs(row.dose - 1)), rel=0.03)
    assert found.recommended_dose == 1.0
    assert nominal.worst_readability == pytest.approx(100 / 6, rel=0.05)


def test_shrinkage_alone_is_no_wrong_exposure_and_the_nearest_height_wins():
    shrunk = [
        replace(ladder(dose), height_um=(0.6 * ladder(dose).height_um).astype(np.float32))
        for dose in (0.9, 1.0, 1.15)
    ]
    found, _ = dose_matrix(shrunk)
    assert not any(row.under_exposed or row.over_exposed for row in found.rows)
    # 0.6 · 1.15 = 0.69 is the nearest to 1.
    assert found.recommended_dose == 1.15


def test_a_tilted_scan_does_not_change_its_dose_row():
    level_scan = ladder(1.0)
    y = np.linspace(-0.1, 0.1, 60, dtype=np.float32)[:, None]
    tilted = replace(level_scan, height_um=level_scan.height_um + y)
    rows = [dose_matrix([scan, ladder(1.1)])[0].rows[0] for scan in (level_scan, tilted)]
    assert rows[1].roughness_nm == pytest.approx(rows[0].roughness_nm, rel=1e-3)
    assert rows[1].height_gain == pytest.approx(rows[0].height_gain, abs=1e-4)


def test_without_two_doses_there_is_no_matrix_and_a_note_says_so():
    for scans, reason in (
        ([ladder(1.0), ladder(1.0, seed=1)], "every dose in the store is 1"),
        (make_scans(2, size_px=64), "needs a column 'dose'"),
    ):
        found, (note,) = dose_matrix(scans)
        assert found is None
        assert reason in note


def narrow_print(dose):
    scan = make_scans(1, size_px=64)[0]
    scan.mask_level[::2] = 0
    return replace(scan, id=f"N{dose:g}", dose=dose)


def test_doses_of_narrow_structures_are_left_out_and_named():
    found, (note,) = dose_matrix([narrow_print(0.9), narrow_print(1.1), ladder(1.0)])
    assert found is None
    assert note.startswith("No dose matrix: prints at dose 0.9, 1.1 have fewer than 3 levels")
    found, (note,) = dose_matrix([narrow_print(0.9), ladder(1.0), ladder(1.1)])
    assert [row.dose for row in found.rows] == [1.0, 1.1]
    assert note.startswith("Left out of the dose matrix: prints at dose 0.9 have")


# --- bounds -------------------------------------------------------------------------------------


def test_repeated_prints_give_their_noise():
    first = make_scans(1, size_px=128, noise_um=0.0)[0]
    repeats = [
        replace(
            first,
            id=f"R{n}",
            height_um=(first.height_um + rough((128, 128), 0.012, n) + 0.05 * n).astype(np.float32),
        )
        for n in range(3)
    ]
    found = repeated_prints([*repeats, make_scans(2, size_px=128)[1]])
    assert found.scans == 3
    # Three pairs of 16,384 white pixels: 0.3 %.
    assert found.sigma_nm == pytest.approx(12, rel=0.02)
    assert found.mae_nm == pytest.approx(np.sqrt(2 / np.pi) * 12, rel=0.02)


def test_other_doses_are_no_repeats():
    first = make_scans(1, size_px=64)[0]
    assert repeated_prints([replace(first, id=f"D{dose}", dose=dose) for dose in (0.9, 1.1)]) is None


def test_the_high_band_holds_its_share_of_white_noise_and_no_layout():
    sigma_um, pitch_um, cutoff = 0.008, 0.1, 2.4
    white = np.random.default_rng(3).normal(0, sigma_um, (256, 256))
    y, x = np.meshgrid(*(np.arange(256) * pitch_um for _ in range(2)), indexing="ij")
    print_um = 0.4 * np.sin(2 * np.pi * 0.5 * x) * np.cos(2 * np.pi * 0.8 * y)
    found = high_band_sigma_nm(white + print_um, pitch_um, cutoff)
    # Share of the plane beyond the square |f| ≤ 2.4 of Nyquist 5: 1 − 0.48².
    assert found == pytest.approx(8 * np.sqrt(1 - 0.48**2), rel=0.02)


def test_like_neighbourhoods_show_the_noise_without_a_model():
    scans = make_scans(3, size_px=256, noise_um=0.010, datum_um=0.03)
    found = neighbourhood_noise(scans, pixels_per_scan=2500)
    # White noise of 10 nm; σ² of 7,500 pixels with 12 neighbours each is known to some 2 %, and the printer
    # is a function of one blurred layout, nearly linear: what remains to extrapolate is small.
    assert found.sigma_nm == pytest.approx(10, rel=0.08)
    assert found.mae_nm == pytest.approx(np.sqrt(2 / np.pi) * 10, rel=0.08)
    assert found.sigma_nm <= found.nearest_sigma_nm


def test_what_a_dose_changes_is_no_noise_of_like_neighbourhoods():
    plain = make_scans(3, size_px=192, noise_um=0.010)
    dosed = [
        replace(
            scan,
            dose=dose,
            height_um=(scan.height_um + (dose - 1) * printed_height_um(scan.layout_um)).astype(np.float32),
        )
        for scan, dose in zip(plain, (0.7, 1.0, 1.3), strict=True)
    ]
    found = neighbourhood_noise(dosed, pixels_per_scan=2500)
    # As above for one dose; each dose now has a third of the pixels, which leave more to extrapolate.
    assert found.sigma_nm == pytest.approx(10, rel=0.1)
    assert found.scans == 3


def test_a_field_too_small_for_pairs_of_its_own_dose_is_no_evidence():
    # 80 px less a border of 32 px on each side leaves 1.6 x 1.6 µm: no two places are 4 µm apart.
    alone = replace(make_scans(1, size_px=80)[0], dose=0.9)
    assert neighbourhood_noise([alone]) is None


# --- σ(x) and its calibration -------------------------------------------------------------------


def test_a_planted_log_variance_is_found_by_maximum_likelihood():
    random = np.random.default_rng(5)
    design = np.stack([np.ones(60_000), random.uniform(0, 1, 60_000), random.normal(0, 1, 60_000)], axis=1)
    truth = np.array([3.0, 1.5, -0.8])
    residual = random.normal(0, 1, 60_000) * sigma_nm(truth, design)
    found = fit_log_variance(design, residual)
    # Fisher information ½ XᵀX: the covariance is 2 (XᵀX)⁻¹.
    error = np.sqrt(np.diag(2 * np.linalg.inv(design.T @ design)))
    assert (np.abs(found - truth) < 4 * error).all()
    score = design.T @ (residual**2 / sigma_nm(found, design) ** 2 - 1)
    assert np.abs(score).max() < 1e-5 * len(residual)


def planted_residuals(count=10, size_px=96, seed=0):
    """Residuals whose σ grows with slope and level."""
    scans = make_scans(count, size_px=size_px)
    beta = np.zeros(len(COVARIATES))
    beta[[0, 1, 3]] = [2 * np.log(8.0), 1.0, 2.5]
    random = np.random.default_rng(seed)
    sigmas = [sigma_nm(beta, np.moveaxis(covariate_maps(scan), 0, -1)) for scan in scans]
    residuals = [random.normal(0, 1, sigma.shape) * sigma for sigma in sigmas]
    return scans, residuals, sigmas


def test_a_spread_by_covariates_is_calibrated_where_a_constant_one_is_not():
    scans, residuals, _ = planted_residuals()
    residuals[0][:10] = np.nan
    found = analyse_spread(Residuals("made", scans, residuals, None, 1, True))
    constant, by_covariates = found.calibrations
    assert by_covariates.nll < constant.nll - 0.02
    assert by_covariates.crps_nm < constant.crps_nm
    assert by_covariates.ence < constant.ence
    assert by_covariates.ause < constant.ause
    for level, share in zip(by_covariates.levels, by_covariates.coverage, strict=True):
        # 90,000 pixels: 0.2 %; the fit on eight scans adds as much.
        assert share == pytest.approx(level, abs=0.01)
    # The PIT of the right Gaussian is flat: 1/20 per bin.
    assert np.abs(np.array(by_covariates.pit) - 0.05).max() < 0.004
    assert by_covariates.conformal_factor == pytest.approx(1.0, abs=0.05)
    for row in found.bins:
        assert row.predicted_nm == pytest.approx(row.rms_nm, rel=0.06)


def test_the_variance_is_judged_on_scans_it_was_not_fitted_on():
    scans, residuals, _ = planted_residuals(count=5)
    loud = [100 * residuals[0], *residuals[1:]]
    quiet = analyse_spread(Residuals("made", scans, residuals, None, 1, True)).calibrations[1]
    alarmed = analyse_spread(Residuals("made", scans, loud, None, 1, True)).calibrations[1]
    # Its own residuals do not reach the σ that a scan is judged with: hundredfold stands out hundredfold.
    assert alarmed.scans[0].standardised_rms == pytest.approx(100 * quiet.scans[0].standardised_rms, rel=1e-9)
    assert alarmed.scans[1].standardised_rms < quiet.scans[1].standardised_rms


def test_disagreement_of_members_is_their_sample_spread_without_their_datum():
    truth = np.random.default_rng(1).normal(0, 0.1, (64, 64))
    deviations = [rough((64, 64), 0.004, seed) for seed in range(8)]
    members = [truth + deviation + 0.03 * n for n, deviation in enumerate(deviations)]
    spread = disagreement_um(members)
    # Mean square over 4,096 pixels and 7 degrees of freedom: 1 %.
    assert float(np.sqrt(np.mean(spread**2))) == pytest.approx(0.004, rel=0.03)


def test_a_scan_level_promise_needs_scans():
    assert conformal_factor([1.0] * 8) is None
    assert conformal_factor(list(range(1, 10))) == 9
    assert conformal_factor(list(range(1, 20))) == 18


# --- the command --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("noise") / "made.zarr", make_scans(8, size_px=128))


def test_a_store_without_references_gets_a_lower_bound_that_is_one(store, tmp_path):
    from litho_models.noise import NoiseAnalysis, analyse_noise
    from litho_models.scoring.noise_floor import noise_floor

    result = analyse_noise(store, tmp_path / "out")
    assert NoiseAnalysis.read(tmp_path / "out") == result
    # Planted: 4 nm of white noise.
    assert result.noise_floor.kind == "lower-bound"
    assert 2.5 < result.noise_floor.rmse_nm <= 4.0
    assert all(bound.contains and bound.lacks for bound in result.bounds)
    assert len(result.run.dropped) == 1
    assert noise_floor("made", tmp_path / "out") == result.noise_floor
    with pytest.raises(InputError, match="neural-lithography"):
        noise_floor("neural-lithography", tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "lower bound" in page
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_a_store_of_ordinary_layouts_with_doses_has_bounds_and_no_matrix(tmp_path):
    from litho_models.noise import analyse_noise

    doses = (0.9, 1.0, 1.1, 0.9, 1.0, 1.1)
    scans = [replace(scan, dose=dose) for scan, dose in zip(make_scans(6, size_px=64), doses, strict=True)]
    for scan in scans:
        scan.mask_level[::2] = 0
    result = analyse_noise(write_store(tmp_path / "dosed.zarr", scans), tmp_path / "out")
    assert result.dose is None
    assert result.bounds
    assert any("No dose matrix: prints at dose 0.9, 1, 1.1" in note for note in result.notes)


def test_a_locked_print_is_in_the_dose_matrix_and_in_nothing_else(tmp_path):
    from litho_models.noise import analyse_noise

    doses = [0.8, 0.9, 1.0, 1.1, 1.2]
    prints = [replace(ladder(dose), order=number, print_id=str(number)) for number, dose in enumerate(doses)]
    result = analyse_noise(write_store(tmp_path / "doses.zarr", prints), tmp_path / "out")
    (locked,) = locked_ids(prints)
    assert [row.scans for row in result.dose.rows] == [[scan.id] for scan in prints]
    assert result.run.dropped == [f"{locked}: lock box, in the dose matrix only"]
    assert any(note.endswith(f"no model: {locked}.") for note in result.notes)
    assert result.run.n_scans == 4
    assert max(bound.scans for bound in result.bounds) == 4
    assert locked in (tmp_path / "out" / "report.html").read_text()


def test_residuals_of_a_benchmark_are_out_of_fold_and_locked_scans_stay_out(store, tmp_path):
    from litho_models.evaluation.benchmark import benchmark
    from litho_models.noise import analyse_noise

    folders = [tmp_path / "b0", tmp_path / "b1"]
    for seed, folder in enumerate(folders):
        benchmark(
            store,
            folder,
            models=("affine", "linear"),
            folds=3,
            settings={"nuisance": "offset"},
            open_lock_box=True,
            seed=seed,
        )
    result = analyse_noise(store, tmp_path / "out", residuals=folders)
    spread = result.spread
    assert (spread.model, spread.members, spread.held_out) == ("linear", 2, True)
    assert len(spread.calibrations) == 3
    assert len(spread.calibrations[0].scans) == 7
    assert spread.epistemic_rms_nm > 0
    # Planted noise 4 nm; the model adds what it lacks.
    assert 3.9 < spread.residual_rms_nm < 12
    with (tmp_path / "out" / "calibration_scans.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for level, share in zip(
        spread.calibrations[0].levels, spread.calibrations[0].scans[0].coverage, strict=True
    ):
        assert float(rows[0][f"coverage_{100 * level:.0f}"]) == pytest.approx(share, abs=5e-4)
    chosen = analyse_noise(store, tmp_path / "affine", residuals=folders[:1], model="affine").spread
    assert chosen.model == "affine"
    assert chosen.residual_rms_nm > spread.residual_rms_nm
    with pytest.raises(InputError, match="model of"):
        analyse_noise(store, tmp_path / "none", residuals=folders, model="pbl")
    with pytest.raises(InputError, match="one source twice"):
        analyse_noise(store, tmp_path / "none", residuals=[folders[0], folders[0]])
    with pytest.raises(InputError, match="no residuals"):
        analyse_noise(store, tmp_path / "none", model="linear")
    other = write_store(tmp_path / "other.zarr", make_scans(3, size_px=64))
    with pytest.raises(InputError, match="dataset of"):
        analyse_noise(other, tmp_path / "none", residuals=folders)


def test_residuals_of_a_frozen_model_say_what_it_saw(store, tmp_path):
    from litho_models.fitting.runs import train
    from litho_models.noise import analyse_noise

    train(store, "linear", tmp_path / "run")
    spread = analyse_noise(store, tmp_path / "out", residuals=[tmp_path / "run" / "model"]).spread
    assert not spread.held_out
    assert len(spread.calibrations[0].scans) == 7
    with pytest.raises(InputError, match="a frozen one"):
        analyse_noise(store, tmp_path / "none", residuals=[tmp_path / "run" / "model"], model="linear")


def test_residuals_are_those_of_the_benchmark_and_of_the_evaluation(tmp_path):
    from litho_data.store import open_store
    from litho_models.evaluation.benchmark import benchmark
    from litho_models.evaluation.evaluate import evaluate
    from litho_models.fitting.runs import train
    from litho_models.noise.residuals import read_residuals

    # A bow of 30 nm in every scan, which a residual without the shared background would hold.
    bowed = write_store(tmp_path / "bowed.zarr", make_scans(6, size_px=96, bow_um=0.03))
    scored = benchmark(bowed, tmp_path / "b", models=("linear",), folds=2, policy="offset-gain", seed=3)
    train(bowed, "linear", tmp_path / "run")
    model = tmp_path / "run" / "model"
    evaluated = evaluate(model, bowed, tmp_path / "e")
    for source, nuisance, scores in (
        (tmp_path / "b", scored.nuisance, scored.scores[0]),
        (model, evaluated.nuisance, evaluated.scores),
    ):
        found = read_residuals(open_store(bowed), [source])
        assert found.protocol == nuisance
        assert nuisance.background == "training"
        # Every pixel is valid, so that the mean over pixels is the mean over scans.
        mae_nm = np.mean(np.abs(found.residuals_nm))
        assert mae_nm == pytest.approx(scores.mae_datum_free_nm, rel=1e-6)
        assert mae_nm < 0.8 * scores.without_background[1].mae_nm


def test_the_command_takes_single_files(tmp_path):
    from typer.testing import CliRunner

    from litho_models.cli.app import app
    from litho_models.noise import NoiseAnalysis

    files = {
        "substrate": rough((128, 128), 0.00125, 1),
        "flat": rough((128, 128), 0.016, 2),
        "steps": staircase(0.016),
    }
    options = []
    for use, height in files.items():
        np.save(tmp_path / f"{use}.npy", height)
        options += [f"--{use}", str(tmp_path / f"{use}.npy")]
    arguments = [
        "noise",
        *options,
        "--unit",
        "um",
        "--size-um",
        "12.8",
        "12.8",
        "--out",
        str(tmp_path / "out"),
    ]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 0, outcome.output
    found = NoiseAnalysis.read(tmp_path / "out")
    assert found.noise_floor.kind == "measured"
    # What the print adds: √(16² − 1.25²).
    offset = next(one for one in found.references.print_noise if one.background == "offset")
    assert offset.print_nm == pytest.approx(np.sqrt(16**2 - 1.25**2), rel=1e-3)
    assert found.references.steps[0].resolvable_step_nm == pytest.approx(READABLE_AT * 16, rel=0.02)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ([], "got nothing to analyse"),
        (["--steps", "F"], "got --steps, wanted a store, or --flat"),
        (["STORE", "--substrate", "F", "--steps", "F"], "got a store and --substrate, --steps"),
        (["STORE", "--level-height-um", "0.2"], "got a store and --level-height-um"),
        (["--flat", "F", "--residuals", "B", "--seed", "1"], "got --flat and --residuals, --seed"),
        (["--flat", "F", "--level-height-um", "0.2"], "got --level-height-um, wanted --steps"),
    ],
)
def test_the_command_refuses_options_that_it_would_not_use(tmp_path, given, said):
    from typer.testing import CliRunner

    from litho_models.cli.app import app

    refused = CliRunner().invoke(app, ["noise", *given, "--out", str(tmp_path / "none")])
    assert isinstance(refused.exception, InputError)
    assert said in str(refused.exception)
