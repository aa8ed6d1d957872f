"""Check the linear algebra of least squares on problems with known solutions."""

from __future__ import annotations

import numpy as np

from litho_models.fitting.least_squares import gram, orthonormal, solve_damped


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
    """Check the Karush-Kuhn-Tucker conditions: the slope is zero inside the box and points outwards at its
    bounds.
    """
    rng = np.random.default_rng(6)
    a = rng.normal(size=(20, 4)) @ np.diag([1.0, 30.0, 0.03, 5.0])
    normal, right = a.T @ a, a.T @ rng.normal(size=20)
    free = solve_damped(normal, right, 0.0)
    lowest, highest = np.minimum(0.5 * free, 0), np.maximum(0.5 * free, 0)
    lowest[3], highest[3] = -1e3, 1e3
    step = solve_damped(normal, right, 0.0, (lowest, highest))
    assert ((step >= lowest) & (step <= highest)).all()
    slope = (normal @ step - right) / np.sqrt(np.diag(normal))
    # lsq_linear stops at a relative tolerance of 1e-10, and the factorisation is regularised by 1e-10.
    size = 1e-6 * np.abs(right / np.sqrt(np.diag(normal))).max()
    inside = (step > lowest + 1e-9) & (step < highest - 1e-9)
    assert inside[3]
    assert np.allclose(slope[inside], 0, atol=size)
    assert (slope[step <= lowest + 1e-9] >= -size).all()
    assert (slope[step >= highest - 1e-9] <= size).all()
    # Clipping the unconstrained step is worse, because it does not adjust the other numbers.
    cut = np.clip(free, lowest, highest)
    assert _quadratic(normal, right, step) < _quadratic(normal, right, cut)


def _quadratic(normal: np.ndarray, right: np.ndarray, x: np.ndarray) -> float:
    return float(x @ normal @ x / 2 - right @ x)
