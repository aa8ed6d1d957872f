"""Joint fit of the base model's few parameters and of the effects, once for all scans and per fold.

Separable least squares: datum, tilt, bow and warp of each scan are projected out, so that they
cannot pull the process parameters. Derivatives are one-sided differences; a model with many
parameters (a network) is kept as it is and only the effects are fitted.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from litho_models.effects import get_effect
from litho_models.effects.chain import EffectChain
from litho_models.loop.linear import COMMON_WEIGHT, gram, nuisance_columns, orthonormal, solve_damped
from litho_models.loop.parameters import (
    difference_steps,
    effect_slots,
    get_vector,
    room,
    set_vector,
    within_bounds,
)
from litho_models.loop.prepared import Field

_STEPS = 12
# The way to the neighbourhood of the optimum is walked on every third scan.
_START_EVERY = 3
_FOLD_STEPS = 6
_FOLD_GAIN = 1e-4
# Keeps combinations of parameters without influence where the common fit put them.
_FOLD_DAMPING = 1e-6
_RELATIVE_GAIN = 5e-4
_DAMPING_TRIES = 4


@dataclass(frozen=True)
class Linearisation:
    """One scan at given parameters: residual (n,), derivatives (n, p) and per-scan basis (n, k), µm."""

    residual: np.ndarray
    jacobian: np.ndarray
    basis: np.ndarray

    def normal(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Normal matrix, right-hand side and weighted sum of squares."""
        full = gram(np.column_stack([self.jacobian, self.residual]), self.basis, COMMON_WEIGHT)
        return full[:-1, :-1], full[:-1, -1], float(full[-1, -1])


@dataclass(frozen=True)
class FoldFits:
    """Parameters for all development scans and for each fold, and where each scan is held out.

    Attributes:
        chain: the model; its parameters are set by ``set_vector``.
        common: (p,) fitted on all development scans.
        per_fold: (folds, p), each fitted without its own scans.
        training_error: (folds,) weighted sum of squares over the scans of each of these fits, µm².
        covariance: (p, p), cluster-robust over scans.
        linear: linearisation of each development scan at ``common``; a parameter that has run against
            its bound has no derivative there, since it cannot follow a candidate outwards.
    """

    chain: EffectChain
    common: np.ndarray
    per_fold: np.ndarray
    training_error: np.ndarray
    covariance: np.ndarray
    linear: list[Linearisation]


def fit_folds(chain: EffectChain, fields: Sequence[Field], fold_of: np.ndarray) -> FoldFits:
    """Fit on all scans, then without each fold in turn.

    The fold fits start at the common fit and are iterated to their own stationary point, first with
    its derivatives, then with their own, so that the start leaves next to no trace of the held-out
    scans.

    Args:
        chain: base and effects at their starting values; copied, not changed.
        fields: development scans; ``fold_of``: (len(fields),) fold that holds each out.
    """
    chain = copy.deepcopy(chain)
    if len(fields) > 2 * _START_EVERY:
        _fit_common(chain, fields[::_START_EVERY])
    common, linear = _fit_common(chain, fields)
    own = [
        _fit_without(chain, common, linear, fields, np.flatnonzero(fold_of != fold))
        for fold in range(int(fold_of.max()) + 1)
    ]
    per_fold, training_error = np.stack([vector for vector, _ in own]), np.array([error for _, error in own])
    free = within_bounds(chain, common)
    linear = [replace(part, jacobian=part.jacobian * free) for part in linear]
    return FoldFits(chain, common, per_fold, training_error, _robust_covariance(linear), linear)


def predict(chain: EffectChain, vector: np.ndarray, field: Field) -> np.ndarray:
    """Predicted height (y, x) float32, µm."""
    set_vector(chain, vector)
    return _with_height_effects(chain, _base_height(chain, field), field)


def _base_height(chain: EffectChain, field: Field) -> Tensor:
    """Height (1, 1, y, x) of the base model on the layout with the layout effects, µm."""
    select = getattr(chain.base, "select", None)
    if select is not None:
        select(field.id)
    with torch.no_grad():
        return chain.base(chain.before_base(field.layout, field.context))


def _with_height_effects(chain: EffectChain, base_height: Tensor, field: Field) -> np.ndarray:
    with torch.no_grad():
        return chain.after_base(base_height, field.context)[0, 0].numpy()


def linearise(chain: EffectChain, vector: np.ndarray, field: Field) -> Linearisation:
    """Residual and derivatives of one scan at the sampled pixels."""
    set_vector(chain, vector)
    base_height = _base_height(chain, field)
    prediction = _with_height_effects(chain, base_height, field)
    here = field.at_sample(prediction)
    # What acts on the height leaves the base model's height, most of the work, as it is.
    after_base = {i for (name, _), i in effect_slots(chain).items() if get_effect(name).acts_on == "height"}
    columns = []
    for i, step in enumerate(difference_steps(chain, vector)):
        moved = vector.copy()
        moved[i] += step
        set_vector(chain, moved)
        height = base_height if i in after_base else _base_height(chain, field)
        columns.append((field.at_sample(_with_height_effects(chain, height, field)) - here) / step)
    jacobian = np.stack(columns, axis=1) if columns else np.empty((len(here), 0))
    basis = orthonormal(nuisance_columns(field, prediction, gain=False))
    return Linearisation(field.height - here, jacobian, basis)


def _fit_common(chain: EffectChain, fields: Sequence[Field]) -> tuple[np.ndarray, list[Linearisation]]:
    vector, damping = get_vector(chain), 1e-3
    linear = [linearise(chain, vector, field) for field in fields]
    if not len(vector):
        return vector, linear
    after = np.inf
    for _ in range(_STEPS):
        parts = [part.normal() for part in linear]
        normal, right = np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0)
        before = sum(p[2] for p in parts)
        for _ in range(_DAMPING_TRIES):
            trial = vector + solve_damped(normal, right, damping, room(chain, vector))
            after = sum(
                _sum_of_squares(part, field, predict(chain, trial, field))
                for part, field in zip(linear, fields, strict=True)
            )
            if after < before:
                break
            damping *= 10
        if after >= before:
            break
        vector, damping = trial, damping / 10
        linear = [linearise(chain, vector, field) for field in fields]
        if before - after < _RELATIVE_GAIN * before:
            break
    set_vector(chain, vector)
    return vector, linear


def _fit_without(
    chain: EffectChain,
    common: np.ndarray,
    linear: Sequence[Linearisation],
    fields: Sequence[Field],
    training: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Fit on some of the scans, and their weighted sum of squares; cheap steps with the common derivatives,
    full ones where those fail."""
    parts = [linear[i].normal() for i in training]
    if not len(common):
        return common, sum(p[2] for p in parts)
    normal, right = np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0)
    start = best = sum(p[2] for p in parts)
    vector = common
    for _ in range(_FOLD_STEPS):
        moved = vector + solve_damped(normal, right, _FOLD_DAMPING, room(chain, vector))
        right, total = np.zeros(len(vector)), 0.0
        for i in training:
            residual = fields[i].height - fields[i].at_sample(predict(chain, moved, fields[i]))
            _, own, squares = Linearisation(residual, linear[i].jacobian, linear[i].basis).normal()
            right += own
            total += squares
        gained, vector = best - total, moved
        if abs(gained) <= _FOLD_GAIN * total:
            return vector, total
        if total > start:
            break
        best = total
    set_vector(chain, common)
    vector, linear = _fit_common(chain, [fields[i] for i in training])
    return vector, sum(part.normal()[2] for part in linear)


def _sum_of_squares(part: Linearisation, field: Field, prediction: np.ndarray) -> float:
    residual = (field.height - field.at_sample(prediction))[:, None]
    return float(gram(residual, part.basis, COMMON_WEIGHT)[0, 0])


def _robust_covariance(linear: Sequence[Linearisation]) -> np.ndarray:
    if not linear[0].jacobian.shape[1]:
        return np.empty((0, 0))
    parts = [part.normal() for part in linear]
    normal = np.sum([p[0] for p in parts], axis=0)
    inverse = np.linalg.pinv(normal, rcond=1e-10, hermitian=True)
    scores = np.stack([p[1] for p in parts])
    count = len(parts)
    return inverse @ (scores.T @ scores) @ inverse * count / max(count - 1, 1)
