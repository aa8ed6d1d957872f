"""Fit small models by least squares: a damped Gauss-Newton method that also solves for the terms of each
scan.

The loss is a sum of squares or a sum of absolute values. Absolute values are minimised as squares with the
weights 1/sqrt(r² + δ²). A ``Problem`` provides the residuals and derivatives of a model: a model of the zoo,
or the model of the loop with its effects. It also provides the ``room``: the smallest and largest step
allowed for each parameter.
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

# δ: for smaller residuals, the loss is nearly quadratic. δ is far below the noise of a print (16 nm).
ABSOLUTE_WIDTH_UM = 0.002
_DAMPING_START = 1e-3
# A combination of unit columns with a smaller squared norm is rounding error.
_SMALLEST_EIGENVALUE = 1e-10
_WEAKEST_INFLUENCE = 1e-8


@dataclass(frozen=True)
class Linearised:
    """One scan, linearised at given parameters: values in µm at n pixels.

    Attributes:
        residual: measured minus predicted, (n,).
        jacobian: derivatives of the prediction, (p, n).
        basis: free terms of the scan, (k, n).
    """

    residual: Array
    jacobian: Array
    basis: Array


class Problem(Protocol):
    """The interface that a model must provide to be fitted, scan by scan."""

    def linearise(self, vector: Array) -> list[Linearised]:
        """Linearise all scans at these parameters."""

    def residuals(self, vector: Array) -> list[Array]:
        """Return the measured minus predicted heights (n,) of all scans, µm."""

    def room(self, vector: Array) -> Room | None:
        """Return the smallest and largest step (p,) allowed from here; None if any step is allowed."""


@dataclass(frozen=True)
class Rules:
    """Settings of a fit.

    Attributes:
        loss: the quantity that is minimised.
        term_weight: with ``squares``, the weight of the part of a residual that scan terms can explain. This
            weight is large enough to determine the common part of the terms, which is the datum. It is small
            enough that no single scan biases the parameters.
        pinned: with ``absolute``, the number of leading scan terms whose mean over the scans is held at zero.
        steps: largest number of steps.
        relative_gain: the fit ends after a step that gains less than this fraction of the loss.
        tries: largest number of attempts at one step. Each attempt has ten times the damping of the previous
            one.
        lowest_damping: lower limit on the damping.
        kept_above: derivatives are reused while the gain of a step is at least this fraction of the predicted
            gain. With None, they are never reused.
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
    """The fitted parameters (p,), the scans linearised at them, and the loss after each step."""

    vector: Array
    linear: list[Linearised]
    losses: list[float]


def fit_least_squares(
    problem: Problem, start: Array, rules: Rules, shown: Callable[[range], Iterable[int]] = iter
) -> LeastSquaresFit:
    """Fit the parameters of a problem, beginning at ``start`` and keeping its dtype. ``shown`` may wrap the
    range of the steps to show progress.
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
        # A small gain shows convergence only if the derivatives were not reused from an earlier point.
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
    """Normal equations. The first rows are those of the parameters, the next are those of the scan terms, and
    the last are the conditions that pin leading terms.

    With ``squares``, the terms of the scans are eliminated, and only rows for the parameters remain.
    """

    matrix: Array
    right: Array
    count: int
    term_shape: tuple[int, int]
    loss: float

    @classmethod
    def at(cls, linear: Sequence[Linearised], terms: Array | None, rules: Rules) -> NormalEquations:
        """Set up the equations for linearised scans with the present ``terms`` (scans, k)."""
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
        """Return the step of the parameters, which stays within their room, and the changes of the terms
        (scans, k).
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
        # The terms are solved for again with the limited step, because those of the unlimited step do not
        # match it.
        rest = self.right[count:] - self.matrix[count:, :count] @ step
        scans, each = self.term_shape
        if not scans * each:
            return step, np.zeros(self.term_shape)
        terms = np.linalg.lstsq(self.matrix[count:, count:], rest, rcond=1e-14)[0]
        return step, terms[: scans * each].reshape(scans, each)

    def _parameters_only(self) -> tuple[Array, Array]:
        """Eliminate the terms of the scans from the equations."""
        count = self.count
        if len(self.matrix) == count:
            return self.matrix, self.right
        columns = np.column_stack([self.matrix[count:, :count], self.right[count:]])
        solved = np.linalg.lstsq(self.matrix[count:, count:], columns, rcond=1e-14)[0]
        across = self.matrix[:count, count:] @ solved
        return self.matrix[:count, :count] - across[:, :-1], self.right[:count] - across[:, -1]


def promised_gain(matrix: Array, right: Array, step: Array) -> float:
    """Return the reduction of the sum of squares that the normal equations, (p, p) and (p,), predict for a
    step (p,).
    """
    return float(2 * right @ step - step @ matrix @ step)


def with_residuals(linear: Sequence[Linearised], left: Sequence[Array]) -> list[Linearised]:
    """Return all scans with new residuals (n,), µm, and unchanged derivatives."""
    return [replace(part, residual=own) for part, own in zip(linear, left, strict=True)]


def eliminated(part: Linearised, term_weight: float) -> tuple[Array, Array, float]:
    """Return the normal matrix, right side and weighted sum of squares of one scan, after eliminating its own
    terms.
    """
    full = gram(np.vstack([part.jacobian, part.residual]).T, part.basis.T, term_weight)
    return full[:-1, :-1], full[:-1, -1], float(full[-1, -1])


def eliminated_sum(linear: Sequence[Linearised], term_weight: float) -> tuple[Array, Array, float]:
    """Return the results of ``eliminated``, summed over scans."""
    parts = [eliminated(part, term_weight) for part in linear]
    normal, right = np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0)
    return normal, right, sum(p[2] for p in parts)


def weighted_squares(residuals: Sequence[Array], linear: Sequence[Linearised], term_weight: float) -> float:
    """Return the sum of squares of the residuals (n,) of these scans. The part that the terms of a scan can
    explain has the weight ``term_weight``.
    """
    return sum(
        float(gram(r[:, None], part.basis.T, term_weight)[0, 0])
        for r, part in zip(residuals, linear, strict=True)
    )


def solve_damped(normal: Array, right: Array, damping: float, room: Room | None = None) -> Array:
    """Minimise x·A·x / 2 - b·x + damping x·diag(A)·x / 2 inside a box. Parameters that have no effect are
    allowed.

    If the unlimited step were computed first and then cut to its bounds, the other parameters would still be
    those of the uncut step, and fits with an optimum on a bound would converge slowly.

    Args:
        normal, right: A (p, p), positive semi-definite, and b (p,).
        damping: relative to the diagonal.
        room: lowest and highest allowed x, two arrays (p,); by default, there are no limits.
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
    # lsq_linear needs distinct bounds; a parameter without room is not changed.
    width = np.maximum(room[1] - room[0], 1e-12)
    box = (room[0] * scale, (room[0] + width) * scale)
    return lsq_linear(factor.T, target, box, method="bvls").x / scale


def orthonormal(columns: Array) -> Array:
    """Return an orthonormal basis (n, k') of the span of the columns, which may be zero or linearly
    dependent.
    """
    if not columns.shape[1]:
        return columns
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
    sizes, directions = np.linalg.eigh(scaled.T @ scaled)
    kept = sizes > _SMALLEST_EIGENVALUE * max(sizes.max(), np.finfo(float).tiny)
    return scaled @ (directions[:, kept] / np.sqrt(sizes[kept]))


def gram(columns: Array, basis: Array, weight_in_basis: float = 0.0) -> Array:
    """Return inner products (m, m) of the columns (n, m), with the part inside the basis (n, k) multiplied by
    ``weight_in_basis``.
    """
    return columns.T @ columns - (1 - weight_in_basis) * gram_inside(columns, basis)


def gram_inside(columns: Array, basis: Array) -> Array:
    """Return the inner products (m, m) of the columns after projection onto an orthonormal basis (n, k)."""
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
