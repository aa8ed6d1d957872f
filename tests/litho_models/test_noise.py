"""Check that planted noise is found, that closed forms hold, and that no fit is judged on the data that it
used.
"""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
import zarr
from scipy.integrate import quad
from scipy.stats import norm
from scipy.stats import t as student

from litho_data.foundation.errors import InputError
from litho_data.store import open_store
from litho_data.store.lock_box import locked_ids
from litho_data.store.write import write_scan_group
from litho_models.noise.budget import noise_budget
from litho_models.noise.calibration import Stated, _bins, analyse_spread, calibrate
from litho_models.noise.dose import dose_matrix
from litho_models.noise.references import repeated_prints, store_references
from litho_models.noise.residuals import Residuals
from litho_models.noise.spread_scores import (
    GAUSSIAN,
    Tails,
    normalised_calibration_error,
    sparsification_error,
)
from litho_models.noise.staircase import READABLE_AT, _piecewise_constant, find_edges, step_print
from litho_models.noise.surface import print_noise, surface_noise
from litho_models.noise.variance import (
    COVARIATES,
    covariates_of,
    fit_log_scale,
    fit_spread,
    place_maps,
    scale_nm,
)
from litho_models.scoring import like_layouts, noise_floor
from litho_models.scoring.like_layouts import like_pixels
from litho_models.scoring.noise_floor import estimated_floor, floor_of_residuals, freed_by_policy
from litho_models.scoring.statistics import bootstrap_interval
from tests.figures import undrawn
from tests.litho_models.prints import make_scans, printed_height_um, write_store


@pytest.fixture
def random():
    """Return a new random generator for each test, so that tests do not depend on each other."""
    return np.random.default_rng(0)


def drawn(freedom, size, random):
    """Draw from Student's t. Unlike NumPy, this accepts infinite degrees of freedom."""
    return random.normal(size=size) if np.isinf(freedom) else random.standard_t(freedom, size)


# --- closed forms -------------------------------------------------------------------------------


@pytest.mark.parametrize("freedom", [np.inf, 4.0, 10.0])
@pytest.mark.parametrize(("residual", "sigma"), [(0.0, 1.0), (1.3, 0.7), (-4.0, 2.5)])
def test_crps_is_the_integral_that_defines_it(residual, sigma, freedom):
    below, _ = quad(lambda x: student.cdf(x / sigma, freedom) ** 2, -np.inf, residual, limit=200)
    above, _ = quad(lambda x: student.sf(x / sigma, freedom) ** 2, residual, np.inf, limit=200)
    # The numerical integration is accurate to 1e-8.
    assert float(Tails(freedom).crps(np.array(residual), sigma)) == pytest.approx(below + above, abs=1e-6)


def test_crps_becomes_the_absolute_error_without_spread():
    residual = np.array([-3.0, 0.5, 8.0])
    assert np.allclose(GAUSSIAN.crps(residual, 1e-9), np.abs(residual), atol=1e-8)


@pytest.mark.parametrize("freedom", [np.inf, 6.0])
def test_the_scores_are_best_at_the_true_spread(random, freedom):
    tails = Tails(freedom)
    residual = 3.0 * drawn(freedom, 40_000, random)
    for score in (lambda r, s: -tails.log_likelihood(r, s), tails.crps):
        at = [score(residual, sigma).mean() for sigma in (2.4, 3.0, 3.6)]
        assert at[1] < at[0]
        assert at[1] < at[2]
    assert np.allclose(tails.log_likelihood(residual, 2.0), student.logpdf(residual / 2, freedom) - np.log(2))
    assert tails.sd == pytest.approx(student.std(freedom))


@pytest.mark.parametrize("freedom", [np.inf, 5.0])
@pytest.mark.parametrize("level", [0.5, 0.68, 0.8, 0.9, 0.95])
def test_coverage_of_the_right_shape_is_its_level(level, freedom, random):
    residual = 2.0 * drawn(freedom, 100_000, random)
    # The binomial standard deviation is √(p(1 − p)/n) ≤ 0.0016.
    assert Tails(freedom).covered(residual, 2.0, level).mean() == pytest.approx(level, abs=0.007)


def test_ence_is_the_relative_error_of_sigma(random):
    sigma = np.repeat([1.0, 2.0, 5.0, 9.0], 1000)
    # Residuals of ± σ have an rms of σ in every bin.
    residual = sigma * random.choice([-1.0, 1.0], sigma.size)
    assert normalised_calibration_error(residual, sigma) == pytest.approx(0, abs=1e-12)
    assert normalised_calibration_error(residual, 2 * sigma) == pytest.approx(0.5)
    assert normalised_calibration_error(residual, sigma / 2) == pytest.approx(1.0)
    # The rms of the four values of σ is wrong for each of them, but a constant σ has only one bin.
    constant = np.full(sigma.size, np.sqrt(np.mean(sigma**2)))
    assert normalised_calibration_error(residual, constant) == pytest.approx(0, abs=1e-12)
    # The rms of n Gaussian pixels has a relative sd of 1/√(2n), so its mean deviation is 1/√(πn). Ten bins
    # of 4,000 pixels give this to a quarter.
    steady = random.uniform(1, 9, 40_000)
    gaussian = steady * random.normal(0, 1, steady.size)
    assert normalised_calibration_error(gaussian, steady) == pytest.approx(
        1 / np.sqrt(4000 * np.pi), abs=1 / np.sqrt(4000 * np.pi)
    )


def test_ause_of_uniform_errors_has_closed_forms(random):
    error = (np.arange(10_000) + 0.5) / 10_000
    residual = random.permutation(error) * random.choice([-1.0, 1.0], error.size)
    size = np.abs(residual)
    # For errors uniform on 0 ... 1, the mean of the lowest share q is q times the whole mean, and that of the
    # highest share 2 − q times. The areas are 1/2 and 3/2, and 1 for equal σ. The integrals are replaced by
    # sums over 10,000 pixels.
    assert sparsification_error(residual, size) == 0
    assert sparsification_error(residual, np.full(error.size, 3.0)) == pytest.approx(0.5, abs=2e-4)
    assert sparsification_error(residual, 1 / size) == pytest.approx(1.0, abs=2e-4)
    # The result is the same for another unit of σ or any increasing function of it.
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
    found = print_noise(above, [below])
    # Fields are scaled to their sample sd, so only a chance correlation of 1/√n_eff remains.
    chance = 2 * 15.9 * 1.25 / np.sqrt(above.independent_heights) / 15.9
    assert found.print_nm == pytest.approx(15.9, abs=3 * chance + 1e-6)
    assert above.mae_nm == pytest.approx(np.sqrt(2 / np.pi) * above.sigma_nm, rel=0.05)
    # In white noise, every pixel is independent. Noise blurred by s has ρ = exp(−r²/4s²), so Σρ² = 2πs²
    # pixels count as one height.
    wanted = 2 * np.pi * correlation_px**2 if correlation_px else 1.0
    assert flat.size / above.independent_heights == pytest.approx(wanted, rel=0.1)


def test_the_uncertainty_of_sigma_is_its_scatter():
    found = [surface_noise("s", rough_free(seed), "offset") for seed in range(60)]
    scatter = np.std([one.sigma_nm for one in found], ddof=1)
    stated = np.mean([one.sigma_uncertainty_nm for one in found])
    # The standard deviation of 60 values has an error of 9 %.
    assert stated == pytest.approx(scatter, rel=0.2)


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
        [surface_noise("substrate", rough((64, 64), 0.002), "offset")],
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
    # The blur of 2.5 px displaces the edge by less than this width.
    assert np.abs(np.array(edges) - [50, 100, 150, 200]).max() <= 2


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("degrees", [-3.0, 1.0])
def test_a_tilt_along_the_stairs_adds_no_steps(axis, degrees):
    tilt_um = np.tan(np.radians(degrees)) * 0.1 * np.arange(250)
    tilt_um = tilt_um if axis == "x" else tilt_um[:, None]
    plain = step_print("plain", staircase(0.01, axis=axis), (0.1, 0.1), 0.1)
    tilted = step_print("tilted", staircase(0.01, axis=axis) + tilt_um, (0.1, 0.1), 0.1)
    assert tilted.axis == axis
    assert np.allclose(tilted.edges_um, plain.edges_um, atol=0.1)
    assert tilted.tread_sigma_nm == pytest.approx(plain.tread_sigma_nm, rel=0.01)
    with pytest.raises(InputError, match="no step"):
        find_edges(rough((200, 250), 0.01) + (tilt_um if axis == "x" else tilt_um[:200]), 0.1)


def test_narrow_blurred_treads_are_not_taken_for_a_tilt():
    from scipy.ndimage import gaussian_filter1d

    # The treads are 4.4 standard deviations of the blur wide.
    profile = gaussian_filter1d(np.repeat(np.arange(24) * 0.1, 11), 2.5, mode="nearest")
    _, edges = find_edges(np.broadcast_to(profile, (20, profile.size)), 0.1)
    assert np.allclose(edges, 11 * np.arange(1, 24), atol=1)


def test_unmeasured_columns_do_not_move_the_edges():
    height = staircase(0.01)
    _, edges = find_edges(height, 0.1)
    height[:, 20:32] = np.nan
    _, found = find_edges(height, 0.1)
    assert np.allclose(found, edges, atol=1)
    assert step_print("gap", height, (0.1, 0.1), 0.1).tread_sigma_nm == pytest.approx(10, rel=0.02)


@pytest.mark.parametrize("narrowest", [3, 4, 5, 6])
def test_no_tread_is_narrower_than_the_narrowest(narrowest):
    edges = _piecewise_constant(np.repeat([0.0, 0.3, 0.0], [10, 4, 9]), 0.01, narrowest)
    assert np.diff(edges) == max(4, narrowest)


def test_step_heights_readability_and_misreading_follow_from_the_noise():
    sigma_um, step_um = 0.016, 0.08
    found = step_print("steps", staircase(sigma_um, step_um, tilt_um=0.03), (0.1, 0.1), 0.1)
    assert len(found.steps) == 4
    assert found.tread_sigma_nm == pytest.approx(16, rel=0.02)
    assert found.resolvable_step_nm == pytest.approx(2 * GAUSSIAN.half_width(0.95) * 16, rel=0.02)
    for step in found.steps:
        assert step.height_nm == pytest.approx(80, abs=4 * step.uncertainty_nm + 0.5)
        assert step.readability == pytest.approx(5, rel=0.05)
        # From some 7,000 pixels, the share Φ(−2.5) = 0.6 % has a standard deviation of 0.1 %.
        assert step.misread == pytest.approx(norm.cdf(-2.5), abs=0.004)


def test_a_flat_surface_has_no_steps():
    with pytest.raises(InputError, match="no step"):
        find_edges(rough((100, 100), 0.01), 0.1)


# --- dose ---------------------------------------------------------------------------------------


def ladder(dose, sigma_um=0.006, seed=0):
    """Return a ladder of levels at a dose. At doses below 0.8, the low levels print nothing. At doses above
    1.2, the high levels saturate.
    """
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
    # Levels 0, 1 and 2 have the same height, so two steps are lost. Level 6 would exceed 0.75 µm (0.78 µm).
    assert (under.lost_low, under.lost_high) == (2, 0)
    assert (over.lost_low, over.lost_high) == (0, 2)
    for row in (low, nominal, high):
        assert (row.lost_low, row.lost_high) == (0, 0)
        # The tilt along the ladder is known only from the slopes within 9 treads of 20 x 40 px, where x has a
        # spread of 20/√12 of 360 px. Noise of 6 nm causes an error of 4.4 nm over the field: 0.6 % of 800 nm.
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
    assert not any(row.lost_low or row.lost_high for row in found.rows)
    # The gain nearest to 1 is 0.6 · 1.15 = 0.69.
    assert found.recommended_dose == 1.15


def test_a_tilted_scan_does_not_change_its_dose_row():
    level_scan = ladder(1.0)
    y = np.linspace(-0.1, 0.1, 60, dtype=np.float32)[:, None]
    tilted = replace(level_scan, height_um=level_scan.height_um + y)
    rows = [dose_matrix([scan, ladder(1.1)])[0].rows[0] for scan in (level_scan, tilted)]
    assert rows[1].roughness_nm == pytest.approx(rows[0].roughness_nm, rel=1e-3)
    assert rows[1].height_gain == pytest.approx(rows[0].height_gain, abs=1e-4)


def part_of_ladder(dose, first, last, datum_um=0.0):
    """Return a scan of the levels ``first`` to ``last`` of a ladder."""
    scan, columns = ladder(dose, seed=first), slice(40 * first, 40 * (last + 1))
    return replace(
        scan,
        id=f"{scan.id}L{first}",
        mask_level=scan.mask_level[:, columns],
        height_um=scan.height_um[:, columns] + np.float32(datum_um),
        valid=scan.valid[:, columns],
    )


def test_scans_of_different_levels_are_brought_to_one_zero():
    doses = [0.8, 1.0, 1.2]
    scans = [
        part_of_ladder(dose, *levels)
        for dose in doses
        for levels in ((6, 8, 0.3), (0, 4, -0.1), (4, 7, 0.05))
    ]
    found, notes = dose_matrix(scans)
    assert notes == []
    assert found.recommended_dose == 1.0
    for row in found.rows:
        assert len(row.scans) == 3
        assert [entry.level for entry in row.levels] == list(range(9))
        # The tilt of each part is known less well than that of a whole ladder.
        assert row.height_gain == pytest.approx(row.dose, abs=0.04)


def test_a_scan_that_shares_no_level_is_left_out_and_named():
    parts = [part_of_ladder(dose, *levels) for dose in (0.9, 1.0) for levels in ((0, 4), (6, 8))]
    found, (note,) = dose_matrix(parts)
    assert "D0.9L6, D1L6, because no wide area has a level in common" in note
    assert [row.scans for row in found.rows] == [["D0.9L0"], ["D1L0"]]
    assert [entry.level for entry in found.rows[0].levels] == [0, 1, 2, 3, 4]


def test_without_two_doses_there_is_no_matrix_and_a_note_says_so():
    for scans, reason in (
        ([ladder(1.0), ladder(1.0, seed=1)], "all scans in the store have the same dose, 1"),
        (make_scans(2, size_px=64), "no scan in the store states a dose (column 'dose'"),
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


def test_the_pitch_of_a_reference_is_that_of_its_own_arrays(tmp_path):
    path = write_store(tmp_path / "made.zarr", make_scans(1, size_px=64))
    pitch_um, height = (0.21, 0.105), rough((32, 48), 0.001).astype(np.float32)
    heights = {"raw_height_um": height, "levelled_height_um": height}
    write_scan_group(zarr.open_group(path, mode="r+"), "bare", heights, "substrate", pitch_um)
    (found,) = store_references(open_store(path))
    assert (found.id, found.use, found.pitch_um) == ("bare", "substrate", pitch_um)


# --- repeats ------------------------------------------------------------------------------------


def test_repeated_prints_give_their_noise():
    first = make_scans(1, size_px=128, noise_um=0.0)[0]
    repeats = [
        replace(
            first,
            id=f"R{n}",
            print_id=f"R{n}",
            height_um=(first.height_um + rough((128, 128), 0.012, n) + 0.05 * n).astype(np.float32),
        )
        for n in range(3)
    ]
    found = repeated_prints([*repeats, make_scans(2, size_px=128)[1]])
    assert found.scans == 3
    # From three pairs of 16,384 white pixels, σ has an error of 0.3 %.
    assert found.sigma_nm == pytest.approx(12, rel=0.02)
    assert found.mae_nm == pytest.approx(np.sqrt(2 / np.pi) * 12, rel=0.02)


@pytest.mark.parametrize("count", [5, 12])
def test_the_interval_of_repeated_prints_is_that_of_the_rms_over_prints(count):
    first = make_scans(1, size_px=64, noise_um=0.0)[0]
    sigmas_nm = [5.0 if n % 2 else 30.0 for n in range(count)]
    repeats = [
        replace(
            first,
            id=f"R{n}",
            print_id=f"R{n}",
            height_um=(first.height_um + rough((64, 64), sigma / 1e3, n)).astype(np.float32),
        )
        for n, sigma in enumerate(sigmas_nm)
    ]
    found = repeated_prints(repeats)
    if count < 6:
        assert found.ci95_nm is None
    else:
        assert found.ci95_nm[0] < found.sigma_nm < found.ci95_nm[1]
        # The difference of two prints has the sum of their variances.
        wanted = np.sqrt(bootstrap_interval(np.square(sigmas_nm)))
        # The noise of two prints of 4,096 pixels has a correlation of about 1/64 by chance.
        assert found.ci95_nm == pytest.approx(wanted, rel=0.03)


def test_other_doses_are_no_repeats():
    first = make_scans(1, size_px=64)[0]
    doses = [replace(first, id=f"D{dose}", print_id=f"D{dose}", dose=dose) for dose in (0.9, 1.1)]
    assert repeated_prints(doses) is None


@pytest.mark.parametrize("places", [(None, None), (0.0, 30.0)])
def test_two_scans_of_one_field_are_no_repeats(places):
    """Check two fields that are each scanned twice. The roughness of a field is the same in both scans."""
    first = make_scans(1, size_px=128, noise_um=0.0)[0]
    scans = [
        replace(
            first,
            id=f"F{field}S{scan}",
            print_id="one" if places[field] is not None else f"P{field}",
            field_x_um=places[field],
            field_y_um=places[field],
            direction=(1.0, -1.0)[scan],
            height_um=first.height_um
            + rough((128, 128), 0.016, field).astype(np.float32)
            + rough((128, 128), 0.002, 10 + 2 * field + scan).astype(np.float32),
        )
        for field in range(2)
        for scan in range(2)
    ]
    assert repeated_prints(scans[:2]) is None
    found = repeated_prints(scans)
    assert found.scans == 2
    assert found.sigma_nm == pytest.approx(np.hypot(16, 2), rel=0.03)
    # Without a stated position, two scans of one print may show the same field.
    assert repeated_prints([replace(scan, print_id="one", field_y_um=None) for scan in scans]) is None


# --- the budget ---------------------------------------------------------------------------------


def heights_um(scans):
    return [printed_height_um(scan.layout_um) for scan in scans]


def floor(scans, maps_um, *policies):
    return floor_of_residuals("made", scans, freed_by_policy(scans, maps_um, policies=policies))


def test_the_floor_is_the_planted_noise_whatever_the_model_lacks(monkeypatch):
    """Check that the floor does not include the error of a model with a wrong gain. This error is larger than
    the noise.
    """
    monkeypatch.setattr(like_layouts, "_PIXELS_PER_SCAN", 1500)
    scans = make_scans(12, size_px=128, noise_um=0.020, datum_um=0.03, bow_um=0.02)
    wrong = [0.85 * height for height in heights_um(scans)]
    found = floor(scans, wrong, "none", "offset", "full")
    assert np.std([1e3 * (scan.height_um - height) for scan, height in zip(scans, wrong, strict=True)]) > 40
    # With 1,500 pixels of each of 12 scans, σ² is known to a few times √(2/18,000), because partners are
    # shared: below 3 %. Partners lie elsewhere in the field, so the bow adds 20 nm · √(4/45) = 6 nm in
    # quadrature.
    bowed = float(np.hypot(20, 20 * np.sqrt(4 / 45)))
    for policy, sigma in (("offset", bowed), ("full", 20.0)):
        row = found.at(policy)
        assert row.rmse_nm == pytest.approx(sigma, rel=0.05)
        assert row.mae_nm == pytest.approx(np.sqrt(2 / np.pi) * sigma, rel=0.05)
        assert row.rmse_ci95_nm[0] < row.rmse_nm < row.rmse_ci95_nm[1]
    assert (found.mae_at("offset"), found.mae_at("none")) == (found.mae_nm, found.at("none").mae_nm)
    # The datum of ±30 nm counts as noise if no scan term absorbs it. Of the 11 other scans, 6 have the other
    # sign, so two partners both have it in 3 of 11 pairs, and the variance is 4 · 3/11 · 30².
    assert found.at("none").rmse_nm == pytest.approx(np.hypot(bowed, 30 * np.sqrt(12 / 11)), rel=0.05)


def test_rough_places_keep_their_noise_though_their_partners_are_smooth(random, monkeypatch):
    """Check rare rough places whose partners are smooth. Half of the squared difference is too small for
    them.
    """
    monkeypatch.setattr(like_layouts, "_PIXELS_PER_SCAN", 3000)
    scans = make_scans(4, size_px=96)
    rough_places = [scan.mask_level >= 9 for scan in scans]
    residuals = [
        np.where(place, random.normal(0, 60, place.shape), random.normal(0, 10, place.shape))
        for place in rough_places
    ]
    drawn = like_pixels(scans, [np.ones(scan.shape, bool) for scan in scans])
    own, _ = drawn.noise_squared(residuals)
    rough = np.concatenate(
        [place.reshape(-1)[drawn.pixel[drawn.owner == n]] for n, place in enumerate(rough_places)]
    )
    assert np.sqrt(own[rough].mean()) == pytest.approx(60, rel=0.1)
    value = np.concatenate([r.reshape(-1)[drawn.pixel[drawn.owner == n]] for n, r in enumerate(residuals)])
    pairs = 0.5 * (value[:, None] - value[drawn.partners]) ** 2
    assert np.sqrt(pairs[rough].mean()) < 57
    assert np.sqrt(own[~rough].mean()) == pytest.approx(10, rel=0.1)
    for row, mine in zip(drawn.owner[drawn.partners], drawn.owner, strict=True):
        assert len({*row, mine}) == drawn.partners.shape[1] + 1


def test_the_mean_absolute_noise_needs_no_gaussian(random, monkeypatch):
    """Check noise that is not Gaussian. A factor of √2 between differences and noise would be wrong by 6 %
    for it.
    """
    monkeypatch.setattr(like_layouts, "_PIXELS_PER_SCAN", 3000)
    scans = make_scans(5, size_px=96, noise_um=0.0, datum_um=0.0)
    # The similar pixels depend only on the layouts, so they are searched once.
    similar = like_pixels(scans, [np.ones(scan.shape, bool) for scan in scans])
    monkeypatch.setattr(noise_floor, "like_pixels", lambda *_: similar)
    for draw, low in (("normal", 0), ("laplace", 0), ("uniform", -10)):
        noise = [1e-3 * getattr(random, draw)(low, 10, scan.shape) for scan in scans]
        noisy = [
            replace(scan, height_um=(scan.height_um + own).astype(np.float32))
            for scan, own in zip(scans, noise, strict=True)
        ]
        found = floor(noisy, heights_um(scans), "offset")
        # From 15,000 pixels with four partners each, the error is below 2 %.
        assert found.mae_nm == pytest.approx(1e3 * np.mean(np.abs(noise)), rel=0.025)
        assert found.rmse_nm == pytest.approx(1e3 * np.std(noise), rel=0.025)


def test_changes_by_a_dose_do_not_count_as_noise_of_similar_layouts(monkeypatch):
    monkeypatch.setattr(like_layouts, "_PIXELS_PER_SCAN", 1500)
    plain = make_scans(10, size_px=128, noise_um=0.010, datum_um=0.0)
    dosed = [
        replace(
            scan,
            dose=dose,
            height_um=(scan.height_um + (dose - 1) * printed_height_um(scan.layout_um)).astype(np.float32),
        )
        for scan, dose in zip(plain, (0.9, 1.1) * 5, strict=True)
    ]
    found = floor(dosed, heights_um(dosed), "offset")
    # All prints of one dose lack the same gain. This is a function of the layout, so it is not noise. Little
    # of it remains, because the surroundings of partners are similar but not equal.
    assert found.rmse_nm == pytest.approx(10, rel=0.15)
    one_dose = [replace(scan, dose=None) for scan in dosed]
    # If the doses were ignored, they would add noise of 10 % of about 110 nm rms to the 10 nm.
    assert floor(one_dose, heights_um(dosed), "offset").rmse_nm > 14


def test_two_scans_have_no_floor():
    scans = make_scans(2, size_px=64)
    assert estimated_floor("made", scans, heights_um(scans)).kind == "unknown"


def test_flat_places_show_the_roughness_of_their_level(random):
    scans = make_scans(7, size_px=128, noise_um=0.0)
    scans = [
        replace(
            scan,
            height_um=(scan.height_um + random.normal(0, 0.01 + 0.002 * scan.mask_level)).astype(np.float32),
        )
        for scan in scans
    ]
    found = noise_budget(Residuals("made", scans, heights_um(scans), [], True))
    assert len(found.flat_levels) > 3
    for row in found.flat_levels:
        # From a thousand pixels, σ is known to 2 %. Terms estimated on the other half add to this error.
        assert row.sigma_nm == pytest.approx(10 + 2 * row.level, rel=0.08)


# --- σ(x) and its calibration -------------------------------------------------------------------


@pytest.mark.parametrize("freedom", [np.inf, 6.0])
def test_a_planted_scale_is_found_by_maximum_likelihood(freedom, random):
    design = np.stack([np.ones(60_000), random.uniform(0, 1, 60_000), random.normal(0, 1, 60_000)], axis=1)
    truth, tails = np.array([3.0, 1.5, -0.8]), Tails(freedom)
    residual = drawn(freedom, 60_000, random) * scale_nm(truth, design)
    found = fit_log_scale(design, residual, tails)
    # The covariance is the inverse of the information: (I XᵀX)⁻¹.
    error = np.sqrt(np.diag(np.linalg.inv(tails.information * design.T @ design)))
    assert (np.abs(found - truth) < 4 * error).all()
    z2 = residual**2 / scale_nm(found, design) ** 2
    assert np.abs(design.T @ (tails.weight(z2) * z2 - 1)).max() < 1e-5 * len(residual)
    # The shape is a value of the grid. For a Gaussian, it may be a value that 60,000 pixels cannot rule out.
    shape = fit_spread(design, residual)[1].freedom
    assert shape >= 30 if np.isinf(freedom) else shape == freedom


def planted_residuals(count=10, size_px=96, seed=0, freedom=np.inf):
    """Return scans, residuals, and the σ of these residuals, which grows with slope and level."""
    scans = make_scans(count, size_px=size_px)
    beta = np.zeros(len(COVARIATES))
    knots = [number for number, name in enumerate(COVARIATES) if name.startswith("level")]
    beta[knots] = 2 * np.log(8.0) + np.linspace(0, 1, len(knots))
    beta[COVARIATES.index("slope")] = 2.5
    random = np.random.default_rng(seed)
    sigmas = [scale_nm(beta, covariates_of(place_maps(scan))) for scan in scans]
    residuals = [drawn(freedom, s.shape, random) * s for s in sigmas]
    return scans, residuals, sigmas


@pytest.mark.parametrize("freedom", [np.inf, 6.0])
def test_a_spread_by_covariates_is_calibrated_where_a_constant_one_is_not(freedom):
    scans, residuals, _ = planted_residuals(count=12, freedom=freedom)
    residuals[0][:10] = np.nan
    found = analyse_spread(Residuals("made", scans, [], residuals, True))
    assert found.left_out == "prints"
    assert (found.variance.freedom or np.inf) >= min(freedom, 30)
    constant, by_covariates = found.calibrations
    assert by_covariates.nll < constant.nll - 0.02
    assert by_covariates.crps_nm < constant.crps_nm
    assert by_covariates.ause < constant.ause
    for level, share in zip(by_covariates.levels, by_covariates.coverage, strict=True):
        # From 110,000 pixels, the error is 0.2 %. The fit to ten scans of 5,000 pixels adds as much.
        assert share == pytest.approx(level, abs=0.01)
    # For the right shape, the PIT histogram is flat, with 1/20 per bin.
    assert np.abs(np.array(by_covariates.pit) - 0.05).max() < 0.004
    everything, *groups = found.bins
    assert everything.coverage_68_ci95 == pytest.approx((0.68, 0.68), abs=0.015)
    assert {row.covariate for row in groups} == {"level", "slope", "edge distance", "radius²"}
    for row in (row for row in groups if row.pixels > 5000):
        # The sd √(p(1 − p)/5000) is 0.7 % or 0.3 %. Allow three of them, plus the error of the fit.
        assert row.coverage_68 == pytest.approx(0.68, abs=0.03)
        assert row.coverage_95 == pytest.approx(0.95, abs=0.015)
        assert row.predicted_nm == pytest.approx(row.rms_nm, rel=0.08)


def test_errors_larger_than_stated_are_found_in_all_groups_and_scans(random):
    scans, _, sigmas = planted_residuals(count=3)
    errors = [1.5 * sigma * random.choice([-1, 1], sigma.shape) for sigma in sigmas]
    stated = [Stated(sigma, GAUSSIAN) for sigma in sigmas]
    groups = list(_bins(scans, [place_maps(scan) for scan in scans], errors, stated))
    assert [row.rms_nm for row in groups] == pytest.approx([1.5 * row.predicted_nm for row in groups])
    # All errors lie between one and two σ.
    assert {(row.coverage_68, row.coverage_95) for row in groups} == {(0, 1)}
    judged = calibrate("exact", scans, errors, stated).scans
    assert [row.standardised_rms for row in judged] == pytest.approx([1.5] * 3)
    for row in [*groups, *judged]:
        # The errors have the same order as σ.
        assert (row.ence, row.ause) == pytest.approx((0.5, 0), abs=1e-9)


def test_the_spread_is_judged_on_prints_it_was_not_fitted_on():
    scans, residuals, _ = planted_residuals(count=6, size_px=48)
    assert scans[0].print_id == scans[1].print_id != scans[2].print_id
    loud = [100 * residuals[0], 100 * residuals[1], *residuals[2:]]
    quiet = analyse_spread(Residuals("made", scans, [], residuals, True)).calibrations[1]
    alarmed = analyse_spread(Residuals("made", scans, [], loud, True)).calibrations[1]
    # The σ with which a scan is judged does not depend on residuals of this scan or its print.
    assert alarmed.scans[0].standardised_rms == pytest.approx(100 * quiet.scans[0].standardised_rms, rel=1e-9)
    assert alarmed.scans[2].standardised_rms < quiet.scans[2].standardised_rms


# --- the command --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("noise") / "made.zarr", make_scans(6, size_px=64))


@pytest.mark.pictures
def test_a_store_without_references_has_the_floor_that_residuals_show(store, tmp_path):
    from litho_models.evaluation.benchmark import benchmark
    from litho_models.noise import NoiseAnalysis, analyse_noise
    from litho_models.scoring.noise_floor import stated_floor

    assert analyse_noise(store, tmp_path / "without").noise_floor.kind == "unknown"
    with undrawn():
        scored = benchmark(store, tmp_path / "b", models=("affine", "linear"), folds=2)
    result = analyse_noise(store, tmp_path / "out", residuals=tmp_path / "b")
    assert NoiseAnalysis.read(tmp_path / "out") == result
    # The planted white noise is 4 nm.
    assert result.noise_floor.kind == "upper-estimate"
    assert result.noise_floor.rmse_nm == pytest.approx(4, rel=0.1)
    # A benchmark computes the same floor from its best model and shows it below its errors.
    assert scored.noise_floor == result.noise_floor == result.budget.floor
    assert result.budget.model == "linear"
    error = next(score for score in scored.scores if score.model == "linear").mae_datum_free_nm
    assert scored.noise_floor.mae_nm < error < 1.3 * scored.noise_floor.mae_nm
    assert len(result.run.dropped) == 1
    assert stated_floor("made", tmp_path / "out") == result.noise_floor
    with pytest.raises(InputError, match="neural-lithography"):
        stated_floor("neural-lithography", tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text()
    assert f"At most {result.noise_floor.mae_nm:.2f} nm" in page
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_a_store_of_ordinary_layouts_with_doses_has_no_matrix_and_says_so(tmp_path):
    from litho_models.noise import analyse_noise

    doses = (0.9, 1.0, 1.1, 0.9, 1.0, 1.1)
    scans = [replace(scan, dose=dose) for scan, dose in zip(make_scans(6, size_px=64), doses, strict=True)]
    for scan in scans:
        scan.mask_level[::2] = 0
    result = analyse_noise(write_store(tmp_path / "dosed.zarr", scans), tmp_path / "out")
    assert result.dose is None
    assert any("No dose matrix: prints at dose 0.9, 1, 1.1" in note for note in result.notes)


@pytest.mark.pictures
def test_a_locked_print_is_in_the_dose_matrix_and_in_nothing_else(tmp_path):
    from litho_models.noise import analyse_noise

    doses = [0.8, 0.9, 1.0, 1.1, 1.2]
    prints = [replace(ladder(dose), order=number, print_id=str(number)) for number, dose in enumerate(doses)]
    result = analyse_noise(write_store(tmp_path / "doses.zarr", prints), tmp_path / "out")
    (locked,) = locked_ids(prints)
    assert [row.scans for row in result.dose.rows] == [[scan.id] for scan in prints]
    assert result.run.dropped == [f"{locked}: lock box, used only in the dose matrix"]
    assert any(note.endswith(f"no model: {locked}.") for note in result.notes)
    assert result.run.n_scans == 4
    assert locked in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.long
def test_residuals_of_a_benchmark_are_out_of_fold_and_locked_scans_stay_out(store, tmp_path):
    from litho_models.evaluation.benchmark import benchmark
    from litho_models.noise import analyse_noise

    folder = tmp_path / "b"
    settings = {"nuisance": "offset"}
    models = ("affine", "linear")
    benchmark(store, folder, models=models, folds=3, settings=settings, open_lock_box=True)
    result = analyse_noise(store, tmp_path / "out", residuals=folder)
    spread = result.spread
    assert (spread.model, spread.held_out) == ("linear", True)
    assert len(spread.calibrations) == 2
    assert len(spread.calibrations[0].scans) == 5
    # The planted noise is 4 nm. The model's own error adds to this.
    assert 3.9 < spread.residual_rms_nm < 12
    with (tmp_path / "out" / "calibration_scans.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for level, share in zip(
        spread.calibrations[0].levels, spread.calibrations[0].scans[0].coverage, strict=True
    ):
        assert float(rows[0][f"coverage_{100 * level:.0f}"]) == pytest.approx(share, abs=5e-4)
    chosen = analyse_noise(store, tmp_path / "affine", residuals=folder, model="affine").spread
    assert chosen.model == "affine"
    assert chosen.residual_rms_nm > spread.residual_rms_nm
    with pytest.raises(InputError, match="model of"):
        analyse_noise(store, tmp_path / "none", residuals=folder, model="pbl")
    with pytest.raises(InputError, match="without residuals"):
        analyse_noise(store, tmp_path / "none", model="linear")
    other = write_store(tmp_path / "other.zarr", make_scans(3, size_px=64))
    with pytest.raises(InputError, match="dataset of"):
        analyse_noise(other, tmp_path / "none", residuals=folder)


def test_residuals_of_a_frozen_model_state_which_scans_it_was_trained_on(store, tmp_path):
    from litho_models.fitting.runs import train
    from litho_models.noise import analyse_noise

    train(store, "affine", tmp_path / "run")
    result = analyse_noise(store, tmp_path / "out", residuals=tmp_path / "run" / "model")
    spread = result.spread
    assert not spread.held_out
    # Residuals of scans that the model was fitted to do not estimate the noise.
    assert (result.budget, result.noise_floor.kind) == (None, "unknown")
    assert len(spread.calibrations[0].scans) == 5
    with pytest.raises(InputError, match="with a frozen model"):
        analyse_noise(store, tmp_path / "none", residuals=tmp_path / "run" / "model", model="linear")


def test_residuals_are_those_of_the_benchmark_and_of_the_evaluation(tmp_path):
    from litho_models.evaluation.benchmark import benchmark
    from litho_models.evaluation.evaluate import evaluate
    from litho_models.fitting.runs import train
    from litho_models.noise.residuals import read_residuals

    # Every scan has a bow of 30 nm, which would stay in a residual without the shared background.
    bowed = write_store(tmp_path / "bowed.zarr", make_scans(4, size_px=64, bow_um=0.03))
    scored = benchmark(bowed, tmp_path / "b", models=("linear",), folds=2, policy="offset-gain", seed=3)
    train(bowed, "linear", tmp_path / "run")
    model = tmp_path / "run" / "model"
    evaluated = evaluate(model, bowed, tmp_path / "e")
    for source, nuisance, scores in (
        (tmp_path / "b", scored.nuisance, scored.scores[0]),
        (model, evaluated.nuisance, evaluated.scores),
    ):
        found = read_residuals(open_store(bowed), source)
        assert found.protocol == nuisance
        assert nuisance.background == "training"
        # Every pixel is valid, so the mean over pixels equals the mean over scans.
        mae_nm = np.mean(np.abs(found.residuals_nm))
        assert mae_nm == pytest.approx(scores.mae_datum_free_nm, rel=1e-6)
        assert mae_nm < 0.8 * scores.without_background[1].mae_nm


@pytest.mark.parametrize("instrument", ["afm", "sem"])
def test_residuals_of_a_store_built_anew_are_of_the_scans_and_terms_of_the_evaluation(tmp_path, instrument):
    from litho_models.evaluation.evaluate import evaluate
    from litho_models.fitting.runs import train
    from litho_models.noise.residuals import read_residuals

    first = write_store(tmp_path / "first.zarr", make_scans(4, size_px=48), instrument=instrument)
    lock_box = train(first, "identity", tmp_path / "run").lock_box
    model = tmp_path / "run" / "model"
    # With one scan more, the store locks another scan.
    scans = make_scans(5, size_px=48, datum_um=0.02)
    assert not set(lock_box) & set(locked_ids(scans))
    anew = write_store(tmp_path / "anew.zarr", scans, instrument=instrument)
    found, evaluated = read_residuals(open_store(anew), model), evaluate(model, anew, tmp_path / "e")
    assert [scan.id for scan in found.scans] == evaluated.split.scored_ids
    assert not set(lock_box) & set(evaluated.split.scored_ids)
    assert found.protocol == evaluated.nuisance
    assert found.protocol.policy == ("none" if instrument == "sem" else "offset")


@pytest.mark.pictures
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
    # The roughness of the print alone is √(16² − 1.25²).
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
        (["--flat", "F", "--residuals", "B", "--model", "M"], "got --flat and --residuals, --model"),
        (["--flat", "F", "--level-height-um", "0.2"], "got --level-height-um without --steps"),
    ],
)
def test_the_command_refuses_options_that_it_would_not_use(tmp_path, given, said):
    from typer.testing import CliRunner

    from litho_models.cli.app import app

    refused = CliRunner().invoke(app, ["noise", *given, "--out", str(tmp_path / "none")])
    assert isinstance(refused.exception, InputError)
    assert said in str(refused.exception)
