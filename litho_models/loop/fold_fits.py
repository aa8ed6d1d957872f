"""Joint fit of a small base model's parameters and of the effects, once for all scans and per fold.

What single scans may add is projected out or solved for beside, so that it cannot pull the process
parameters. A base model with many parameters (a network) is kept as it is and only the effects are fitted.
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
from litho_models.fitting.least_squares import (
    LeastSquaresFit,
    Linearised,
    Loss,
    Problem,
    Room,
    Rules,
    eliminated,
    eliminated_sum,
    fit_least_squares,
    orthonormal,
    solve_damped,
    weighted_squares,
)
from litho_models.fitting.pixel_weights import Weighted, Weights, pixel_weights
from litho_models.fitting.small_models import RULES as ZOO_RULES
from litho_models.fitting.small_models import fit_small_model
from litho_models.loop.parameters import (
    chain_at,
    difference_steps,
    effect_slots,
    get_vector,
    model_for,
    room,
    starts_of,
    within_bounds,
)
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms import Terms
from litho_models.scan_terms.training import PINNED
from litho_models.simulator import Simulator, is_small

# What every scan may add in a fit: its gain is left to the process, which long-range effects act on.
FREE_TERMS: Terms = frozenset({"offset", "bow", "warp"})
RULES: dict[Loss, Rules] = {
    "squares": Rules("squares"),
    "absolute": replace(ZOO_RULES, pinned=len(PINNED & FREE_TERMS)),
}
TERM_WEIGHT = RULES["squares"].term_weight
# The way to the neighbourhood of the optimum is walked on every third scan.
_START_EVERY = 3
_FOLD_STEPS = 6
_FOLD_GAIN = 1e-4
# Keeps combinations of parameters without influence where the common fit put them.
_FOLD_DAMPING = 1e-6


@dataclass(frozen=True)
class FoldFits:
    """Parameters for all development scans and for each fold, and where each scan is held out.

    Attributes:
        chain: the model at ``common``.
        common: (p,) fitted on all development scans.
        per_fold: (folds, p), each fitted without its own scans.
        training_error: (folds,) weighted sum of squares over the scans of each of these fits, µm².
        covariance: (p, p), cluster-robust over scans.
        linear: each development scan at ``common``; a parameter that has run against its bound has no
            derivative there, since it cannot follow a candidate outwards.
    """

    chain: EffectChain
    common: np.ndarray
    per_fold: np.ndarray
    training_error: np.ndarray
    covariance: np.ndarray
    linear: list[Linearised]


def fit_folds(
    chain: EffectChain,
    scans: Sequence[PreparedScan],
    fold_of: np.ndarray,
    loss: Loss = "squares",
    weights: Weights = "uniform",
) -> FoldFits:
    """Fit on all scans, then without each fold in turn.

    With ``squares`` the fits of the folds start at the common fit and are iterated to their own stationary
    point, first with its derivatives, then with their own, so that the start leaves next to no trace of the
    held-out scans. With ``absolute`` each starts where the chain stands, as in a benchmark.

    Args:
        chain: base and effects at their starting values.
        scans: development scans; ``fold_of``: (len(scans),) fold that holds each out.
        weights: what pixels count for in the fits; what is derived from them later counts all alike.
    """
    windows = [scan.window for scan in scans]
    training = [np.flatnonzero(fold_of != fold).tolist() for fold in range(int(fold_of.max()) + 1)]
    if loss == "absolute":
        common = _fit_absolute(chain, scans, weights)
        linear = ChainProblem(chain, windows).linearise(common)
        per_fold = np.stack([_fit_absolute(chain, [scans[i] for i in own], weights) for own in training])
        errors = np.array(
            [
                weighted_squares(
                    ChainProblem(chain, [windows[i] for i in own]).residuals(vector),
                    [linear[i] for i in own],
                    TERM_WEIGHT,
                )
                for vector, own in zip(per_fold, training, strict=True)
            ]
        )
    else:
        fitted = _fit_squares(chain, windows, weights)
        common, linear = fitted.vector, fitted.linear
        own_fits = [
            _fit_without(chain, common, [linear[i] for i in own], [windows[i] for i in own], weights)
            for own in training
        ]
        per_fold, errors = np.stack([v for v, _ in own_fits]), np.array([error for _, error in own_fits])
        if weights != "uniform":
            linear = ChainProblem(chain, windows).linearise(common)
    free = within_bounds(chain, common)
    linear = [replace(part, jacobian=part.jacobian * free[:, None]) for part in linear]
    return FoldFits(chain_at(chain, common), common, per_fold, errors, robust_covariance(linear), linear)


def predict(
    chain: EffectChain, vector: np.ndarray, scan: PreparedScan, fold: int | None = None
) -> np.ndarray:
    """Predicted height (y, x) float32, µm, by the chain with these parameters.

    Of a base trained per fold the model of ``fold`` predicts, by default that which has not seen the scan.
    """
    here = chain_at(chain, vector)
    return _with_height_effects(here, _base_height(here, scan, fold), scan)


class ChainProblem:
    """A chain on the sampled pixels of scans; derivatives are one-sided differences.

    Args:
        chain: base and effects; ``scans``: what they are fitted to.
        loss: with ``absolute`` the terms of the scans are those of the catalogue, otherwise orthonormal.
    """

    def __init__(self, chain: EffectChain, scans: Sequence[PreparedScan], loss: Loss = "squares"):
        self._chain = chain
        self._scans = scans
        self._loss = loss
        # What acts on the height leaves the base model's height, most of the work, as it is.
        self._after_base = {
            i for (name, _), i in effect_slots(chain).items() if get_effect(name).acts_on == "height"
        }

    def linearise(self, vector: np.ndarray) -> list[Linearised]:
        """Residuals and derivatives of all scans."""
        here = chain_at(self._chain, vector)
        bases = [_base_height(here, scan) for scan in self._scans]
        predictions = [
            _with_height_effects(here, base, scan) for base, scan in zip(bases, self._scans, strict=True)
        ]
        values = [scan.at_sample(p) for scan, p in zip(self._scans, predictions, strict=True)]
        rows: list[list[np.ndarray]] = [[] for _ in self._scans]
        for i, step in enumerate(difference_steps(self._chain, vector)):
            moved = chain_at(self._chain, vector + step * (np.arange(len(vector)) == i))
            for scan, base, value, own in zip(self._scans, bases, values, rows, strict=True):
                height = base if i in self._after_base else _base_height(moved, scan)
                own.append((scan.at_sample(_with_height_effects(moved, height, scan)) - value) / step)
        return [
            Linearised(
                scan.height - value,
                np.reshape(own, (len(vector), len(scan.sample))),
                self._basis(scan, prediction),
            )
            for scan, value, own, prediction in zip(self._scans, values, rows, predictions, strict=True)
        ]

    def residuals(self, vector: np.ndarray) -> list[np.ndarray]:
        """Measured minus predicted of all scans, µm."""
        here = chain_at(self._chain, vector)
        return [
            scan.height - scan.at_sample(_with_height_effects(here, _base_height(here, scan), scan))
            for scan in self._scans
        ]

    def room(self, vector: np.ndarray) -> Room:
        """Effects stay within their range, the base does not go too far at once."""
        return room(self._chain, vector)

    def _basis(self, scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        terms = scan.terms_at_sample(prediction, FREE_TERMS)
        return orthonormal(terms.T).T if self._loss == "squares" else terms


def _base_height(chain: EffectChain, scan: PreparedScan, fold: int | None = None) -> Tensor:
    """Height (1, 1, y, x) of the base model on the layout with the layout effects, µm."""
    with torch.no_grad():
        return model_for(chain.base, scan.id, fold)(chain.before_base(scan.layout, scan.context))


def _with_height_effects(chain: EffectChain, base_height: Tensor, scan: PreparedScan) -> np.ndarray:
    with torch.no_grad():
        return chain.after_base(base_height, scan.context)[0, 0].numpy()


def _problem(
    chain: EffectChain, windows: Sequence[PreparedScan], weights: Weights, loss: Loss = "squares"
) -> Problem:
    """A chain on windows of scans, their pixels weighted."""
    problem = ChainProblem(chain, windows, loss)
    if weights == "uniform":
        return problem
    return Weighted(problem, [one.at_sample(pixel_weights(one.stored, weights)) for one in windows], loss)


def _fit_absolute(chain: EffectChain, scans: Sequence[PreparedScan], weights: Weights) -> np.ndarray:
    """A base without effects is fitted as any small model of the zoo."""
    if chain.names or not isinstance(chain.base, Simulator) or not is_small(chain.base):
        problem = _problem(chain, [scan.window for scan in scans], weights, "absolute")
        return fit_least_squares(problem, get_vector(chain), RULES["absolute"]).vector
    fitted = copy.deepcopy(chain)
    assert isinstance(fitted.base, Simulator)
    fit_small_model(fitted.base, [scan.stored for scan in scans], "full+rows", weights=weights)
    return get_vector(fitted)


def _fit_squares(chain: EffectChain, windows: Sequence[PreparedScan], weights: Weights) -> LeastSquaresFit:
    """The best of the fits from all starts; of many scans a third decides which one."""
    starts = starts_of(chain)
    if len(windows) > 2 * _START_EVERY:
        some = _problem(chain, windows[::_START_EVERY], weights)
        starts = [_best([fit_least_squares(some, start, RULES["squares"]) for start in starts]).vector]
    every = _problem(chain, windows, weights)
    return _best([fit_least_squares(every, start, RULES["squares"]) for start in starts])


def _best(fits: Sequence[LeastSquaresFit]) -> LeastSquaresFit:
    return min(fits, key=lambda fit: eliminated_sum(fit.linear, TERM_WEIGHT)[2])


def _fit_without(
    chain: EffectChain,
    common: np.ndarray,
    linear: Sequence[Linearised],
    scans: Sequence[PreparedScan],
    weights: Weights,
) -> tuple[np.ndarray, float]:
    """Fit on some of the scans, and their weighted sum of squares; cheap steps with the common derivatives,
    full ones where those fail."""
    problem = _problem(chain, scans, weights)
    normal, right, start = eliminated_sum(linear, TERM_WEIGHT)
    if not len(common):
        return common, start
    vector, best = common, start
    for _ in range(_FOLD_STEPS):
        vector = vector + solve_damped(normal, right, _FOLD_DAMPING, room(chain, vector))
        _, right, total = eliminated_sum(with_residuals(linear, problem.residuals(vector)), TERM_WEIGHT)
        if abs(best - total) <= _FOLD_GAIN * total:
            return vector, total
        if total > start:
            break
        best = total
    fitted = fit_least_squares(problem, common, RULES["squares"])
    return fitted.vector, eliminated_sum(fitted.linear, TERM_WEIGHT)[2]


def with_residuals(linear: Sequence[Linearised], residuals: Sequence[np.ndarray]) -> list[Linearised]:
    """The same scans with other residuals, their derivatives kept."""
    return [replace(part, residual=own) for part, own in zip(linear, residuals, strict=True)]


def robust_covariance(linear: Sequence[Linearised]) -> np.ndarray:
    """Covariance (p, p) of fitted numbers, by what each scan asks for at the optimum."""
    if not len(linear[0].jacobian):
        return np.empty((0, 0))
    parts = [eliminated(part, TERM_WEIGHT) for part in linear]
    normal = np.sum([p[0] for p in parts], axis=0)
    inverse = np.linalg.pinv(normal, rcond=1e-10, hermitian=True)
    scores = np.stack([p[1] for p in parts])
    count = len(parts)
    return inverse @ (scores.T @ scores) @ inverse * count / max(count - 1, 1)
