"""Test the statistics of scans and prints: exact sign flips, the F statistic, and permutation p values."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import f_oneway

from litho_models.scoring.statistics import by_print, one_sided_flip_p, sign_flips

PRINTS = ["1"] * 4 + ["2"] * 3 + ["3"] * 4 + ["4"] * 3


def test_sign_flips_are_exhaustive_for_few_scans_and_hold_the_observed_signs() -> None:
    signs = sign_flips(5)
    assert len({tuple(row) for row in signs}) == 32
    assert (signs[0] == 1).all()
    assert (sign_flips(20)[0] == 1).all()
    assert one_sided_flip_p(np.ones(8)) == 1 / 256


def test_f_is_that_of_a_one_way_analysis_and_p_close_to_its_own():
    values = np.random.default_rng(1).normal(size=14) + 0.8 * np.repeat([0, 1, 0, -1], [4, 3, 4, 3])
    found = by_print(values, PRINTS)
    groups = [values[[own == name for own in PRINTS]] for name in "1234"]
    wanted = f_oneway(*groups)
    assert found.f == pytest.approx(wanted.statistic)
    assert found.degrees == (3, 10)
    # With 1,999 permutations, the standard error is sqrt(p (1 - p) / 1999), which is at most 0.011.
    assert found.p == pytest.approx(wanted.pvalue, abs=0.035)


def test_the_share_that_scans_of_one_print_have_in_common_is_recovered():
    random = np.random.default_rng(2)
    prints = np.repeat(np.arange(300), 4)
    values = random.normal(0, 2.0, 300)[prints] + random.normal(0, 1.0, 1200)
    # The true share is 4 / (4 + 1), which 300 prints give to about 0.02.
    assert by_print(values[:400], prints[:400]).icc == pytest.approx(0.8, abs=0.08)
    assert by_print(random.permutation(values)[:400], prints[:400]).icc < 0.1


def test_columns_count_alike_whatever_their_unit_and_nothing_to_tell_is_none():
    random = np.random.default_rng(3)
    two = random.normal(size=(14, 2))
    assert by_print(two * [1.0, 1e6], PRINTS).f == pytest.approx(by_print(two, PRINTS).f)
    assert by_print(two, ["1"] * 14) is None
    assert by_print(two, range(14)) is None
    assert by_print(np.ones(14), PRINTS) is None
