"""The statistics of the loop on numbers whose answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from litho_models.fitting.least_squares import gram, orthonormal, solve_damped
from litho_models.loop.selection.confirming import (
    BINOMIAL_P,
    FEWEST_SCANS,
    binomial_p,
    confirm,
    confirm_variance,
)
from litho_models.scoring.statistics import (
    family_wise_p,
    one_sided_flip_p,
    sign_flip_statistics,
    sign_flips,
)


@pytest.mark.parametrize(("needed", "count"), [(19, 24), (17, 20), (11, 12), (10, 10), (8, 8)])
def test_scans_needed_for_a_confirmation(needed: int, count: int) -> None:
    assert binomial_p(needed, count) <= 0.005 < binomial_p(needed - 1, count)


def test_fewer_scans_than_its_gates_allow_can_confirm_nothing_and_as_many_can() -> None:
    assert FEWEST_SCANS == 8
    for count in (FEWEST_SCANS - 1, FEWEST_SCANS):
        before, after = np.full(count, 100.0), np.full(count, 50.0)
        maps, left = ([np.full(9, size)] * count for size in (0.01, 0.0))
        enough = count == FEWEST_SCANS
        assert confirm(before, after, before, after).passed is enough
        # By sign flips, too: the smallest p is that of all scans agreeing.
        assert confirm_variance(maps, left, (before, before), (after, after)).passed is enough
        assert (one_sided_flip_p(np.ones(count)) <= BINOMIAL_P) is enough


def test_a_steady_gain_is_confirmed_and_its_rules_fail_one_by_one() -> None:
    rng = np.random.default_rng(0)
    before = 100 + rng.normal(size=12)
    after = before - 10 - rng.normal(size=12)
    verdict = confirm(before, after, before, after, amplitudes={"a": np.array([1.0, 1.1, 0.9])})
    assert verdict.passed
    assert verdict.improved == (12, 12)
    assert verdict.p == pytest.approx(2**-12)
    assert "sign" in confirm(before, after, before, after, amplitudes={"a": np.array([1.0, -1.0])}).reason
    assert "varies" in confirm(before, after, before, after, amplitudes={"a": np.array([1.0, 4.0])}).reason
    assert "small" in confirm(before, before - 0.1, before, before).reason
    assert "interval" in confirm(before, before[::-1], before, before).reason


def test_sign_flips_are_exhaustive_for_few_scans_and_hold_the_observed_signs() -> None:
    signs = sign_flips(5)
    assert len({tuple(row) for row in signs}) == 32
    assert (signs[0] == 1).all()
    assert (sign_flips(20)[0] == 1).all()
    assert one_sided_flip_p(np.ones(8)) == 1 / 256


def test_family_wise_p_is_uniform_without_any_effect() -> None:
    rng = np.random.default_rng(1)
    p = []
    for _ in range(300):
        z, null_max = sign_flip_statistics(rng.normal(size=(10, 6)))
        p.append(family_wise_p(float(np.abs(z).max()), null_max))
    # 300 draws of a uniform p: share below 0.1 is 0.1 +- 0.017; four standard deviations.
    assert abs(np.mean(np.array(p) <= 0.1) - 0.1) < 0.07
    assert np.mean(np.array(p) <= 0.05) < 0.05 + 4 * math.sqrt(0.05 * 0.95 / 300)


def test_cluster_robust_z_is_the_one_of_the_formula() -> None:
    scores = np.array([[1.0], [2.0], [4.0], [3.0]])
    z, _ = sign_flip_statistics(scores)
    expected = 10 / math.sqrt(4 / 3 * ((scores - 2.5) ** 2).sum())
    assert z[0] == pytest.approx(expected)


def test_variance_component_is_confirmed_although_some_scans_do_not_need_it() -> None:
    rng = np.random.default_rng(2)
    offsets = np.concatenate([np.zeros(3), rng.normal(size=9)]) * 0.02
    maps = [o + 0.005 * rng.normal(size=400) for o in offsets]
    left = [m - o - 0.001 * rng.normal() for m, o in zip(maps, offsets, strict=True)]
    before, after = (np.array([1e6 * np.mean(m**2) for m in group]) for group in (maps, left))
    verdict = confirm_variance(maps, left, (before, before), (after, after))
    assert verdict.passed
    nothing = [0.005 * rng.normal(size=400) for _ in offsets]
    noise = [m - 0.001 * rng.normal() for m in nothing]
    b, a = (np.array([1e6 * np.mean(m**2) for m in group]) for group in (nothing, noise))
    assert not confirm_variance(nothing, noise, (b, b), (a, a)).passed


def test_orthonormal_basis_spans_the_columns_and_drops_copies() -> None:
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(50, 3))
    basis = orthonormal(np.column_stack([columns, columns[:, 0] * 2]))
    assert basis.shape == (50, 3)
    assert np.allclose(basis.T @ basis, np.eye(3), atol=1e-9)
    assert np.allclose(basis @ (basis.T @ columns), columns, atol=1e-9)


def test_gram_frees_columns_of_the_basis() -> None:
    rng = np.random.default_rng(4)
    basis = orthonormal(rng.normal(size=(40, 2)))
    columns = rng.normal(size=(40, 3))
    free = columns - basis @ (basis.T @ columns)
    assert np.allclose(gram(columns, basis), free.T @ free)
    assert np.allclose(gram(columns, basis, weight_in_basis=1.0), columns.T @ columns)


def test_damped_solution_is_exact_without_damping_and_indifferent_to_units() -> None:
    rng = np.random.default_rng(5)
    a = rng.normal(size=(20, 3))
    b = rng.normal(size=20)
    units = np.array([1.0, 30.0, 0.03])
    plain = solve_damped(a.T @ a, a.T @ b, 0.0)
    assert np.allclose(plain, np.linalg.lstsq(a, b, rcond=None)[0])
    damped, scaled = (solve_damped((a * u).T @ (a * u), (a * u).T @ b, 0.1) for u in (1.0, units))
    assert np.allclose(damped, scaled * units, rtol=1e-6)


def test_a_step_in_a_box_is_the_best_one_in_it() -> None:
    """Karush-Kuhn-Tucker: inside the box no slope is left; on a bound the slope points out of the box."""
    rng = np.random.default_rng(6)
    a = rng.normal(size=(20, 4)) @ np.diag([1.0, 30.0, 0.03, 5.0])
    normal, right = a.T @ a, a.T @ rng.normal(size=20)
    free = solve_damped(normal, right, 0.0)
    lowest, highest = np.minimum(0.5 * free, 0), np.maximum(0.5 * free, 0)
    lowest[3], highest[3] = -1e3, 1e3
    step = solve_damped(normal, right, 0.0, (lowest, highest))
    assert ((step >= lowest) & (step <= highest)).all()
    slope = (normal @ step - right) / np.sqrt(np.diag(normal))
    # lsq_linear ends at a relative tolerance of 1e-10; the regularisation of the factor is as small.
    size = 1e-6 * np.abs(right / np.sqrt(np.diag(normal))).max()
    inside = (step > lowest + 1e-9) & (step < highest - 1e-9)
    assert inside[3]
    assert np.allclose(slope[inside], 0, atol=size)
    assert (slope[step <= lowest + 1e-9] >= -size).all()
    assert (slope[step >= highest - 1e-9] <= size).all()
    # Cutting the free step is worse: the others do not follow.
    cut = np.clip(free, lowest, highest)
    assert _quadratic(normal, right, step) < _quadratic(normal, right, cut)


def _quadratic(normal: np.ndarray, right: np.ndarray, x: np.ndarray) -> float:
    return float(x @ normal @ x / 2 - right @ x)
