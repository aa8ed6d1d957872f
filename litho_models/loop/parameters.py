"""The numbers that a fit moves: where they stand in one vector, their ranges and difference steps."""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import nn

from litho_models.effects import get_effect
from litho_models.effects.chain import EffectChain
from litho_models.fitting.small_models import parameter_room
from litho_models.loop.folded_base import FoldedBase
from litho_models.simulator import Simulator, is_small

_RELATIVE_STEP = 5e-3
_AT_BOUND = 1e-6


def is_refitted(base: nn.Module) -> bool:
    """Whether the base has parameters, and few enough to be fitted together with the effects."""
    trainable = any(p.requires_grad for p in base.parameters())
    return trainable and is_small(base) and not isinstance(base, FoldedBase)


def get_vector(chain: EffectChain) -> np.ndarray:
    """All fitted numbers: the base's (if it is refitted), then the effects'."""
    return np.concatenate([p.detach().numpy().reshape(-1) for p in _fitted(chain)] or [np.empty(0)]).astype(
        np.float64
    )


def chain_at(chain: EffectChain, vector: np.ndarray) -> EffectChain:
    """A copy of the chain with these numbers, what ``get_vector`` returns; a base that is kept is shared."""
    shared = {} if is_refitted(chain.base) else {id(chain.base): chain.base}
    moved = copy.deepcopy(chain, shared)
    at = 0
    for parameter in _fitted(moved):
        values = vector[at : at + parameter.numel()]
        parameter.data.copy_(torch.as_tensor(values, dtype=parameter.dtype).reshape(parameter.shape))
        at += parameter.numel()
    return moved


def starts_of(chain: EffectChain) -> list[np.ndarray]:
    """Where a fit of the chain may begin: where it stands, and with the base's numbers before any fit.

    The best base without an effect is no good place to look for one beside it: what the base took of the
    effect keeps it there, on the wrong side of a hill.
    """
    stands = get_vector(chain)
    if not (isinstance(chain.base, Simulator) and is_refitted(chain.base)):
        return [stands]
    unfitted = get_vector(chain.over(type(chain.base)(chain.base.config)))
    same = unfitted.shape != stands.shape or np.array_equal(unfitted, stands)
    return [stands] if same else [stands, unfitted]


def model_for(base: nn.Module, scan_id: str, fold: int | None = None) -> nn.Module:
    """The model that predicts a scan: the base, or of one per fold that of ``fold``.

    Without a fold it is the one that has not seen the scan.
    """
    if not isinstance(base, FoldedBase):
        return base
    return base.of_scan(scan_id) if fold is None else base.of_fold(fold)


def effect_slots(chain: EffectChain) -> dict[tuple[str, str], int]:
    """Where each effect parameter sits in the vector."""
    start = len(get_vector(chain)) - len(chain.fitted)
    return {slot: start + i for i, slot in enumerate(chain.fitted)}


def room(chain: EffectChain, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest step (p,) allowed from here: base and effects within their ranges."""
    own = len(vector) - len(chain.fitted)
    lowest, highest = np.zeros(len(vector)), np.zeros(len(vector))
    if own:
        lowest[:own], highest[:own] = parameter_room(chain.base, vector[:own])
    for (name, parameter), slot in effect_slots(chain).items():
        limits = get_effect(name).parameters[parameter]
        lowest[slot], highest[slot] = limits.lower - vector[slot], limits.upper - vector[slot]
    return np.minimum(lowest, 0), np.maximum(highest, 0)


def within_bounds(chain: EffectChain, vector: np.ndarray) -> np.ndarray:
    """True for parameters (p,) with room on both sides."""
    lowest, highest = room(chain, vector)
    return (lowest < -_AT_BOUND) & (highest > _AT_BOUND)


def at_bounds(chain: EffectChain) -> dict[str, float]:
    """Fitted values of base and effects that stand on a bound of their range, and that bound."""
    base = chain.base
    found = base.at_bounds if isinstance(base, Simulator) and is_refitted(base) else {}
    values = chain.values()
    for name, parameter in chain.fitted:
        limits, value = get_effect(name).parameters[parameter], values[name][parameter]
        for bound in (limits.lower, limits.upper):
            if abs(value - bound) < _AT_BOUND * max(1.0, abs(bound)):
                found[f"{name}: {parameter}"] = bound
    return found


def difference_steps(chain: EffectChain, vector: np.ndarray) -> np.ndarray:
    """Difference steps, pointing away from the nearer bound of an effect's range."""
    steps = _RELATIVE_STEP * np.maximum(np.abs(vector), 0.2)
    for (name, parameter), slot in effect_slots(chain).items():
        limits = get_effect(name).parameters[parameter]
        size = 0.05 * abs(limits.typical - limits.null if limits.kind == "amplitude" else limits.typical)
        steps[slot] = size if vector[slot] + size <= limits.upper else -size
    return steps


def _fitted(chain: EffectChain) -> list[nn.Parameter]:
    base = [p for p in chain.base.parameters() if p.requires_grad] if is_refitted(chain.base) else []
    effects = [
        chain.get_parameter(f"{name.replace('-', '_')}__{parameter}") for name, parameter in chain.fitted
    ]
    return base + effects
