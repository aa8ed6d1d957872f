"""Check errors against closed forms, the coverage of confidence intervals, and exact sign-flip p values."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from litho_data.foundation.errors import InputError
from litho_models.scan_terms import POLICIES, cross_fit
from litho_models.scoring.metrics import print_gain, scan_errors
from litho_models.scoring.statistics import (
    FEWEST_FOR_INTERVAL,
    bootstrap_interval,
    over_units,
    smallest_flip_p,
)

VALID = np.ones((256, 256), bool)


def scored(height, prediction, policy="offset"):
    free = cross_fit(height, prediction, np.isfinite(height), POLICIES[policy])
    return scan_errors("a", height, prediction, free)


def test_constant_error_is_bias_and_vanishes_when_the_datum_is_free():
    prediction = np.random.default_rng(0).uniform(0, 1, VALID.shape)
    score = scored(prediction - 0.052, prediction)
    # The bias is measured minus predicted, so it is negative if the print is lower than predicted.
    assert score.bias_nm == pytest.approx(-52)
    assert score.mae_abs_nm == pytest.approx(52)
    assert score.mae_datum_free_nm < 1e-9


def test_gaussian_noise_has_a_mean_absolute_error_of_0_798_sigma():
    random = np.random.default_rng(1)
    noise = random.normal(0, 0.01596, VALID.shape)
    score = scored(noise, np.zeros(VALID.shape), "none")
    # From 65,536 pixels, the mean |n| has a relative standard error of 0.756/256 = 0.3 %. Allow three.
    assert score.mae_datum_free_nm == pytest.approx(15.96 * np.sqrt(2 / np.pi), rel=0.009)
    assert score.rmse_datum_free_nm == pytest.approx(15.96, rel=0.009)
    assert score.median_abs_datum_free_nm == pytest.approx(15.96 * 0.67449, rel=0.015)
    assert score.p95_abs_datum_free_nm == pytest.approx(15.96 * 1.95996, rel=0.015)


def test_gain_and_offset_of_a_known_line():
    x = np.linspace(0, 1.2, VALID.size).reshape(VALID.shape)
    line = print_gain(0.7 * x + 0.05, x, VALID)
    assert (line.slope, line.intercept_nm) == (pytest.approx(0.7), pytest.approx(50))
    assert line.slope_error < 1e-12
    flat = print_gain(x, np.ones(VALID.shape), VALID)
    assert (flat.slope, flat.slope_error) == (None, None)
    assert flat.intercept_nm == pytest.approx(600)


def test_the_error_of_the_gain_is_that_of_repeated_prints():
    random = np.random.default_rng(3)
    prediction = 0.6 + 0.2 * gaussian_filter(random.normal(size=VALID.shape), 4) * 14
    found = []
    for _ in range(300):
        # As on measured prints, the residual is correlated over 7 px, and rougher where the print is high.
        noise = 0.1 * gaussian_filter(random.normal(size=VALID.shape), 3) * (0.5 + prediction)
        found.append(print_gain(0.9 * prediction + 0.03 + noise, prediction, VALID))
    slopes = np.array([line.slope for line in found])
    # The standard deviation of 300 repeats is known to 4 %, that of 64 blocks to 9 % in each repeat. The
    # correlation of neighbouring blocks lowers the latter by a few per cent.
    assert np.mean([line.slope_error for line in found]) == pytest.approx(slopes.std(), rel=0.15)
    # If the pixels were assumed to be independent, the stated error would be several times too small.
    naive = noise.std() / (prediction.std() * np.sqrt(VALID.size))
    assert slopes.std() > 3 * naive


def test_interval_over_scans_covers_the_mean_about_as_often_as_promised():
    random = np.random.default_rng(2)
    hits = 0
    for _ in range(200):
        low, high = bootstrap_interval(random.normal(21, 2, 20).tolist(), draws=500)
        hits += low <= 21 <= high
    # The percentile interval of 20 values covers about 93 %. For 200 trials, the standard error is 1.8 %.
    assert 0.87 <= hits / 200 <= 0.985


def test_one_scan_has_no_interval():
    assert all(np.isnan(end) for end in bootstrap_interval([20.0]))


def test_few_units_have_no_interval_and_enough_have_theirs():
    values = [1.0] * FEWEST_FOR_INTERVAL
    assert over_units(values).ci95_nm == (1.0, 1.0)
    assert over_units(values[1:]).ci95_nm is None


def test_sign_flip_p_of_a_uniform_improvement_is_two_in_two_to_the_n():
    compared = over_units([-1.0] * 6)
    assert compared.p == pytest.approx(2 / 2**6)
    assert (compared.count, compared.positive) == (6, 0)


def test_prints_are_resampled_and_flipped_whole():
    prints, scans_of_each = 6, 4
    groups = [print_ for print_ in "abcdef" for _ in range(scans_of_each)]
    better = over_units([1.0] * len(groups), groups)
    assert (better.count, better.positive) == (prints, prints)
    # Although 24 scans agree, p is no smaller than six prints allow.
    assert better.p == smallest_flip_p(prints) == 1 / 32
    # With one scan per group, the result is the same as for scans.
    values = np.random.default_rng(5).normal(size=8).tolist()
    assert over_units(values) == over_units(values, list("abcdefgh"))
    # If only prints differ, the standard error is that of the mean of prints, sd / sqrt(6). Independent scans
    # would give sd / sqrt(24). Percentiles of 6 values are right within a third.
    shifts = np.random.default_rng(6).normal(size=prints)
    values = np.repeat(shifts, scans_of_each).tolist()
    low, high = bootstrap_interval(values, groups=groups)
    assert high - low == pytest.approx(2 * 1.96 * shifts.std() / np.sqrt(prints), rel=1 / 3)
    by_scan = bootstrap_interval(values)
    assert high - low == pytest.approx(2 * (by_scan[1] - by_scan[0]), rel=1 / 4)


def test_prints_of_unequal_size_count_by_their_scans():
    # With three scans at 0 and one at 4, the mean is 1 over scans and 2 over prints. Draws are in 0 ... 4.
    low, high = bootstrap_interval([0.0, 0.0, 0.0, 4.0], groups=list("aaab"))
    assert (low, high) == (0.0, 4.0)


def test_no_difference_gives_p_of_one():
    assert over_units([0.0, 0.0]).p == 1.0


def test_sampled_and_exact_p_agree():
    random = np.random.default_rng(3)
    difference = random.normal(0.6, 1.0, 14)
    exact = over_units(difference.tolist()).p
    sampled = over_units([*difference.tolist(), 0.0]).p
    # The added scan has no difference, so p is only sampled, by 9,999 draws. Allow three standard errors.
    assert sampled == pytest.approx(exact, abs=3 * np.sqrt(exact * (1 - exact) / 9999) + 1e-4)


@pytest.mark.parametrize(
    "call",
    [
        lambda: over_units([]),
        lambda: scored(np.full((64, 64), np.nan), np.zeros((64, 64)), "none"),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(InputError):
        call()
