"""How well the scans determine the fitted numbers: which of them move together, and how far each may go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import get_effect
from litho_models.effects.chain import EffectChain
from litho_models.fitting.least_squares import eliminated_sum, solve_damped
from litho_models.loop.fold_fits import TERM_WEIGHT, ChainProblem, FoldFits, with_residuals
from litho_models.loop.parameters import effect_slots, is_refitted, room
from litho_models.loop.prepared import PreparedScan

PROFILE_POINTS = 9
# Standard errors on either side of the fitted value.
_REACH = 3.0
_STEPS, _GAIN = 4, 1e-5
# Smaller parts of a direction of unit length are not worth a name.
_NAMED_PART = 0.3


@dataclass(frozen=True)
class Identifiability:
    """Joint conditioning of all fitted numbers, each derivative scaled to unit length.

    Attributes:
        inflation: name to variance inflation: by how much its variance grows because others are fitted too.
        condition: ratio of the largest to the smallest singular value of the derivatives.
        weakest: the combination that the scans say least about, by name; parts of 0.3 and more.
        without_slope: names of numbers that change nothing here: at a bound, or acting through one at zero.
    """

    inflation: dict[str, float]
    condition: float
    weakest: dict[str, float]
    without_slope: tuple[str, ...]


@dataclass(frozen=True)
class Profile:
    """Root mean square residual, nm, with one number ``held`` at each value and all others fitted again.

    The residual is that of the fit: datum, tilt, bow and warp of single scans count next to nothing.
    """

    effect: str
    parameter: str
    unit: str
    fitted: float
    held: np.ndarray
    rmse_nm: np.ndarray


def identifiability(fits: FoldFits) -> Identifiability | None:
    """Conditioning at the fit to all development scans; None where nothing is fitted."""
    normal, _, _ = eliminated_sum(fits.linear, TERM_WEIGHT)
    names = _names(fits.chain)
    free = np.diag(normal) > 0
    if not free.any():
        return None
    scale = np.sqrt(np.diag(normal)[free])
    sizes, directions = np.linalg.eigh(normal[free][:, free] / np.outer(scale, scale))
    sizes = np.maximum(sizes, np.finfo(float).eps)
    known = [name for name, is_free in zip(names, free, strict=True) if is_free]
    weak = directions[:, 0] * np.sign(directions[np.abs(directions[:, 0]).argmax(), 0])
    return Identifiability(
        inflation=dict(zip(known, (directions**2 / sizes).sum(axis=1).tolist(), strict=True)),
        condition=float(np.sqrt(sizes[-1] / sizes[0])),
        weakest={n: float(part) for n, part in zip(known, weak, strict=True) if abs(part) >= _NAMED_PART},
        without_slope=tuple(name for name, is_free in zip(names, free, strict=True) if not is_free),
    )


def profiles(fits: FoldFits, scans: Sequence[PreparedScan]) -> list[Profile]:
    """Profile likelihood of every fitted number of every effect, up to nine values within its range.

    Args:
        fits: the fitted chain.
        scans: development scans that it was fitted to.
    """
    found = []
    for (effect, parameter), slot in effect_slots(fits.chain).items():
        limits = get_effect(effect).parameters[parameter]
        error = float(np.sqrt(max(fits.covariance[slot, slot], 0.0))) or 0.1 * abs(limits.typical)
        fitted = float(fits.common[slot])
        around = fitted + error * np.linspace(-_REACH, _REACH, PROFILE_POINTS)
        values = np.unique(np.clip(around, limits.lower, limits.upper))
        squares = np.array([_squares_with(fits, scans, slot, value) for value in values])
        count = sum(len(scan.sample) for scan in scans)
        rmse_nm = np.sqrt(squares / count) * NM_PER_UM
        found.append(Profile(effect, parameter, limits.unit, fitted, values, rmse_nm))
    return found


def _squares_with(fits: FoldFits, scans: Sequence[PreparedScan], slot: int, value: float) -> float:
    """Weighted sum of squares with one number held and the others stepped with the common derivatives."""
    vector = fits.common.copy()
    vector[slot] = value
    others = np.arange(len(vector)) != slot
    problem, best = ChainProblem(fits.chain, scans), np.inf
    for _ in range(_STEPS):
        normal, right, total = eliminated_sum(
            with_residuals(fits.linear, problem.residuals(vector)), TERM_WEIGHT
        )
        if total > (1 - _GAIN) * best or not others.any():
            return min(total, best)
        best = total
        lowest, highest = room(fits.chain, vector)
        box = (lowest[others], highest[others])
        vector[others] += solve_damped(normal[others][:, others], right[others], 1e-6, box)
    return best


def _names(chain: EffectChain) -> list[str]:
    """Names of what ``get_vector`` returns."""
    names = []
    for name, parameter in chain.base.named_parameters() if is_refitted(chain.base) else ():
        if parameter.requires_grad:
            places = [""] if parameter.numel() == 1 else [f"[{i}]" for i in range(parameter.numel())]
            names += [f"base: {name}{place}" for place in places]
    return names + [f"{effect}: {parameter}" for effect, parameter in chain.fitted]
