"""Fit small models by a damped Gauss-Newton method. The terms of each scan and the parameters of the model
are found together.

The loss is a sum of squared or of absolute residuals r. To minimise absolute residuals, squared residuals are
minimised with the weights 1/sqrt(r² + δ²). A ``Problem`` provides the residuals of a model and their
derivatives. The ``Problem`` also provides the ``room``, i.e. the smallest and the largest allowed step of
each parameter. The fitted model is a process model, or the base model of the closed loop together with its
effects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from scipy.optimize import lsq_linear

from litho_data.foundation.kinds import Array

Loss = Literal["absolute", "squares"]
Room = tuple[Array, Array]

# The width δ. For residuals smaller than δ, the loss is nearly quadratic. δ is far below the noise of a
# measured print (16 nm).
ABSOLUTE_WIDTH_UM = 0.002
_DAMPING_START = 1e-3
# If the squared norm of a combination of normalised columns is below this value, the combination is regarded
# as a rounding error. The value is also added to the diagonal of a matrix that may be singular.
_SMALLEST_EIGENVALUE = 1e-10
_WEAKEST_INFLUENCE = 1e-8


@dataclass(frozen=True)
class Linearised:
    """One scan, and the linearisation of its predicted height at given parameters. All values are in µm, at n
    pixels of the scan.

    Attributes:
        residual: measured minus predicted height; shape (n,).
        jacobian: derivatives of the predicted height with respect to p parameters; shape (p, n).
        basis: values of the k per-scan terms that are fitted to this scan; shape (k, n).
    """

    residual: Array
    jacobian: Array
    basis: Array


class Problem(Protocol):
    """The interface through which a model is fitted to scans. ``vector`` contains the p parameters."""

    def linearise(self, vector: Array) -> list[Linearised]:
        """Return all scans, linearised at the parameters ``vector``."""

    def residuals(self, vector: Array) -> list[Array]:
        """Return the measured minus predicted heights, µm: for each scan an array of shape (n,)."""

    def room(self, vector: Array) -> Room | None:
        """Return the smallest and the largest step allowed from ``vector``, each of shape (p,). Return None
        if any step is allowed.
        """


@dataclass(frozen=True)
class Rules:
    """Settings of a fit.

    Attributes:
        loss: ``absolute`` to minimise the sum of absolute residuals, ``squares`` to minimise the sum of
            squared residuals.
        term_weight: weight of that part of a residual that the terms of the scan can explain; used with the
            loss ``squares``. The weight is small, so the terms of a single scan do not bias the parameters.
            It is not zero, because the fit must also determine the common datum of all scans.
        pinned: number of pinned terms. The mean of a pinned term over the scans is held at zero. Pinned terms
            are used with the loss ``absolute`` and are the first rows of ``Linearised.basis``.
        steps: largest number of steps.
        relative_gain: the fit ends after a step that reduces the loss by less than this fraction of the loss.
        tries: largest number of attempts at one step. Each attempt uses ten times the damping of the previous
            attempt.
        lowest_damping: lower limit of the damping.
        kept_above: the next step reuses the derivatives if the last step has reduced the loss by at least
            this fraction of the predicted reduction. With None, the derivatives are computed anew after every
            step.
    """

    loss: Loss
    term_weight: float = 1e-3
    pinned: int = 0
    steps: int = 12
    relative_gain: float = 5e-4
    tries: int = 4
    lowest_damping: float = 0.0
    kept_above: float | None = None


@dataclass(frozen=True)
class LeastSquaresFit:
    """The result of a fit: the fitted parameters, of shape (p,), the scans linearised at these parameters,
    and the loss after each step.
    """

    vector: Array
    linear: list[Linearised]
    losses: list[float]


def fit_least_squares(
    problem: Problem, start: Array, rules: Rules, shown: Callable[[range], Iterable[int]] = iter
) -> LeastSquaresFit:
    """Fit the parameters of a problem, beginning at the vector ``start``. The fitted parameters have the
    dtype of ``start``. The function ``shown`` receives the range of step numbers and can wrap it in a
    progress display.
    """
    vector, linear = start, problem.linearise(start)
    if not len(start):
        return LeastSquaresFit(vector, linear, [])
    terms = np.zeros((len(linear), len(linear[0].basis))) if rules.loss == "absolute" else None
    damping, losses, fresh = _DAMPING_START, [], True
    for _ in shown(range(rules.steps)):
        equations = NormalEquations.at(linear, terms, rules)
        room = problem.room(vector)
        for _ in range(rules.tries):
            step, term_step = equations.solve(damping, room)
            trial = vector + step.astype(start.dtype)
            moved = None if terms is None else terms + term_step
            left = problem.residuals(trial)
            loss = _total_loss(left, linear, moved, rules)
            if loss <= equations.loss:
                break
            damping *= 10
        else:
            if fresh:
                break
            linear, fresh = problem.linearise(vector), True
            continue
        gained = equations.loss - loss
        vector, terms, damping = trial, moved, max(damping / 10, rules.lowest_damping)
        losses.append(loss)
        small = gained < rules.relative_gain * loss
        # A small gain means convergence only if the derivatives belong to the present parameters.
        ends = small and fresh
        if rules.kept_above is None:
            kept = False
        else:
            promised = promised_gain(equations.matrix, equations.right, step)
            kept = ends or (not small and gained >= rules.kept_above * promised)
        linear = with_residuals(linear, left) if kept else problem.linearise(vector)
        if ends:
            break
        fresh = not kept
    if not fresh:
        linear = problem.linearise(vector)
    return LeastSquaresFit(vector, linear, losses)


@dataclass(frozen=True)
class NormalEquations:
    """The normal equations of one step. The first ``count`` rows belong to the parameters, and the next rows
    to the terms of the scans. The last rows are conditions: for each pinned term (see ``Rules``), the mean
    over the scans is zero.

    With the loss ``squares``, the terms of the scans are eliminated beforehand, so the equations contain only
    the rows of the parameters.
    """

    matrix: Array
    right: Array
    count: int
    term_shape: tuple[int, int]
    loss: float

    @classmethod
    def at(cls, linear: Sequence[Linearised], terms: Array | None, rules: Rules) -> NormalEquations:
        """Set up the equations from the linearised scans and the present values of the per-scan terms.
        ``terms`` has shape (scans, k); with the loss ``squares`` it is None.
        """
        count = len(linear[0].jacobian)
        if terms is None:
            matrix, right, squares = eliminated_sum(linear, rules.term_weight)
            return cls(matrix, right, count, (len(linear), 0), squares)
        each, pinned = terms.shape[1], rules.pinned
        size = count + terms.size
        matrix, right = np.zeros((size + pinned, size + pinned)), np.zeros(size + pinned)
        losses = []
        for number, part in enumerate(linear):
            design = np.concatenate([part.jacobian, part.basis])
            residual = part.residual - terms[number] @ part.basis
            magnitude = _magnitude(residual)
            first = count + number * each
            own = np.r_[0:count, first : first + each]
            matrix[np.ix_(own, own)] += (design / magnitude) @ design.T / residual.size
            right[own] += design @ (residual / magnitude) / residual.size
            for term in range(pinned):
                matrix[size + term, first + term] = matrix[first + term, size + term] = 1
            losses.append(magnitude.mean())
        return cls(matrix, right, count, terms.shape, float(np.mean(losses)))

    def solve(self, damping: float, room: Room | None) -> tuple[Array, Array]:
        """Return the step of the parameters and the change of the scan terms. The step, of shape (p,), stays
        within ``room``. The change has shape (scans, k).
        """
        count = self.count
        if room is not None:
            step = solve_damped(*self._parameters_only(), damping, room)
        else:
            damped = self.matrix.copy()
            diagonal = np.arange(count)
            scale = damped[diagonal, diagonal]
            damped[diagonal, diagonal] += damping * np.maximum(scale, 1e-9 * scale.max())
            step = np.linalg.lstsq(damped, self.right, rcond=1e-14)[0][:count]
        # The change of the terms is computed again for the limited step, because the change found together
        # with the unlimited step does not match the limited step.
        rest = self.right[count:] - self.matrix[count:, :count] @ step
        scans, each = self.term_shape
        if not scans * each:
            return step, np.zeros(self.term_shape)
        terms = np.linalg.lstsq(self.matrix[count:, count:], rest, rcond=1e-14)[0]
        return step, terms[: scans * each].reshape(scans, each)

    def _parameters_only(self) -> tuple[Array, Array]:
        """Eliminate the terms of the scans from the equations. Return the remaining matrix and right side,
        which belong to the parameters.
        """
        count = self.count
        if len(self.matrix) == count:
            return self.matrix, self.right
        columns = np.column_stack([self.matrix[count:, :count], self.right[count:]])
        solved = np.linalg.lstsq(self.matrix[count:, count:], columns, rcond=1e-14)[0]
        across = self.matrix[:count, count:] @ solved
        return self.matrix[:count, :count] - across[:, :-1], self.right[:count] - across[:, -1]


def promised_gain(matrix: Array, right: Array, step: Array) -> float:
    """Return by how much a step reduces the sum of squares according to the normal equations. ``matrix`` has
    shape (p, p); ``right`` and ``step`` have shape (p,).
    """
    return float(2 * right @ step - step @ matrix @ step)


def with_residuals(linear: Sequence[Linearised], left: Sequence[Array]) -> list[Linearised]:
    """Replace the residuals of linearised scans by the arrays in ``left`` (µm, one array of shape (n,) per
    scan). The derivatives stay unchanged.
    """
    return [replace(part, residual=own) for part, own in zip(linear, left, strict=True)]


def eliminated(part: Linearised, term_weight: float) -> tuple[Array, Array, float]:
    """Eliminate the per-scan terms from the normal equations of one scan. Return the remaining normal matrix,
    the right side and the weighted sum of squared residuals. In the inner products, the part of each column
    that the terms of the scan can explain has the weight ``term_weight``.
    """
    full = gram(np.vstack([part.jacobian, part.residual]).T, part.basis.T, term_weight)
    return full[:-1, :-1], full[:-1, -1], float(full[-1, -1])


def eliminated_sum(linear: Sequence[Linearised], term_weight: float) -> tuple[Array, Array, float]:
    """Return the three results of ``eliminated``, each summed over the scans."""
    parts = [eliminated(part, term_weight) for part in linear]
    normal, right = np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0)
    return normal, right, sum(p[2] for p in parts)


def weighted_squares(residuals: Sequence[Array], linear: Sequence[Linearised], term_weight: float) -> float:
    """Return the sum of squared residuals over all scans. ``residuals`` contains one array of shape (n,) per
    scan. The part of a residual that the terms of its scan can explain has the weight ``term_weight``.
    """
    return sum(
        float(gram(r[:, None], part.basis.T, term_weight)[0, 0])
        for r, part in zip(residuals, linear, strict=True)
    )


def solve_damped(normal: Array, right: Array, damping: float, room: Room | None = None) -> Array:
    """Find the damped step x within its limits by minimising x·A·x / 2 - b·x + damping · x·diag(A)·x / 2. The
    matrix A may be singular, because some parameters may have no effect.

    The minimisation takes the limits into account. If the unlimited step were only clipped afterwards, the
    steps of the other parameters would not match the clipped steps, and fits whose optimum is on a bound
    would converge slowly.

    Args:
        normal, right: the positive semi-definite matrix A, of shape (p, p), and the vector b, of shape (p,).
        damping: strength of the damping relative to the diagonal of A.
        room: smallest and largest allowed x, each of shape (p,); by default, there are no limits.
    """
    diagonal = np.diag(normal).copy()
    floor = max(_WEAKEST_INFLUENCE * diagonal.max(), np.finfo(float).tiny)
    scale = np.sqrt(np.maximum(diagonal, floor))
    scaled = normal / np.outer(scale, scale) + damping * np.eye(len(normal))
    step = np.linalg.lstsq(scaled, right / scale, rcond=1e-9)[0] / scale
    if room is None or ((step >= room[0]) & (step <= room[1])).all():
        return step
    factor = np.linalg.cholesky(scaled + _SMALLEST_EIGENVALUE * np.eye(len(normal)))
    target = np.linalg.solve(factor, right / scale)
    # ``lsq_linear`` requires that the two bounds of a parameter differ. Bounds that coincide are moved apart
    # by so little that the parameter hardly moves.
    width = np.maximum(room[1] - room[0], 1e-12)
    box = (room[0] * scale, (room[0] + width) * scale)
    return lsq_linear(factor.T, target, box, method="bvls").x / scale


def orthonormal(columns: Array) -> Array:
    """Return an orthonormal basis of the span of the given columns, which may be zero or linearly dependent.
    For columns of shape (n, k), the basis has shape (n, rank).
    """
    if not columns.shape[1]:
        return columns
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
    sizes, directions = np.linalg.eigh(scaled.T @ scaled)
    kept = sizes > _SMALLEST_EIGENVALUE * max(sizes.max(), np.finfo(float).tiny)
    return scaled @ (directions[:, kept] / np.sqrt(sizes[kept]))


def gram(columns: Array, basis: Array, weight_in_basis: float = 0.0) -> Array:
    """Return the inner products of the columns. The parts of the columns that lie in the span of an
    orthonormal basis contribute with the weight ``weight_in_basis``. ``columns`` has shape (n, m), ``basis``
    has shape (n, k), and the result has shape (m, m).
    """
    return columns.T @ columns - (1 - weight_in_basis) * gram_inside(columns, basis)


def gram_inside(columns: Array, basis: Array) -> Array:
    """Return the inner products of the columns after their projection onto an orthonormal basis. ``columns``
    has shape (n, m), ``basis`` has shape (n, k), and the result has shape (m, m).
    """
    inside = basis.T @ columns
    return inside.T @ inside


def _total_loss(
    residuals: Sequence[Array], linear: Sequence[Linearised], terms: Array | None, rules: Rules
) -> float:
    if terms is None:
        return weighted_squares(residuals, linear, rules.term_weight)
    losses = [
        _magnitude(r - own @ part.basis).mean() for r, own, part in zip(residuals, terms, linear, strict=True)
    ]
    return float(np.mean(losses))


def _magnitude(residual_um: Array) -> Array:
    return np.sqrt(residual_um**2 + ABSOLUTE_WIDTH_UM**2)
