"""Score test of every effect that is not in the model, at its null, with scans as the unit.

Each trial of an effect gives a secant direction J = (Z(trial) - Z(off)). Directions and residual are
freed of per-scan terms and of what the base model's own parameters can do; what is left per scan is a
score <J, r> and an information <J, J>. The null flips the sign of whole scans.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from litho_models.effects import Effect
from litho_models.effects.effect import Parameter
from litho_models.loop.screening.directions import (
    PROJECTIONS,
    Block,
    Directions,
    freed_grams,
    raw_information,
)
from litho_models.scoring.statistics import family_wise_p, sign_flip_statistics

FAMILY_P = 0.05
SAME_COSINE = 0.8
# Of a direction's information, what must survive the projections for a test to mean anything.
SMALLEST_RETAINED = 1e-5
# An effect of which a term of single scans leaves less than this is tested without that term.
SWALLOWED_SHARE = 0.05


@dataclass(frozen=True)
class Screened:
    """What the score test says of one effect.

    ``gain_nm2``: predicted gain in squared error of each scan, its amplitudes estimated without the
    scan's fold. ``signature``: multiples of the directions' columns of the best block. ``retained``: share
    of the information that terms of single scans and the base model's own parameters leave;
    ``beside_base``: what the terms alone leave.
    """

    effect: Effect
    block: Block
    values: dict[str, float]
    z: float
    p: float
    gain_nm2: np.ndarray
    signature: np.ndarray
    projection: str
    in_range: bool
    retained: float
    beside_base: float
    detectable: str

    @property
    def mean_gain_nm2(self) -> float:
        return float(self.gain_nm2.mean())


def screen(directions: Directions, fold_of: np.ndarray) -> list[Screened]:
    """Test every effect, best predicted gain first.

    Args:
        directions: from ``measure_directions``.
        fold_of: (scans,) fold that holds each scan out.
    """
    everything = np.arange(len(fold_of))
    free = {name: freed_grams(directions, name, everything) for name in PROJECTIONS}
    projection = _projection_of_columns(directions, free)
    scores = np.stack([_scores(free[projection[c]], 1 + c) for c in range(len(projection))], axis=1)
    z, null_max = sign_flip_statistics(scores)
    found = []
    effects = {block.effect.name: block.effect for block in directions.blocks}
    for name, effect in effects.items():
        own = [block for block in directions.blocks if block.effect.name == name]
        found.append(_screen_one(effect, own, directions, free, projection, z, null_max, fold_of))
    return sorted(found, key=lambda s: -s.mean_gain_nm2)


def best_by_fold(directions: Directions, screened: Sequence[Screened], fold_of: np.ndarray) -> list[str]:
    """For each fold, the effect with the largest gain predicted from the other scans alone."""
    winners = []
    for fold in range(int(fold_of.max()) + 1):
        training = np.flatnonzero(fold_of != fold)
        freed = {name: freed_grams(directions, name, training) for name in PROJECTIONS}
        gains = {}
        for entry in screened:
            own = [b for b in directions.blocks if b.effect.name == entry.effect.name]
            estimates = [_estimate(freed[entry.projection], b, training) for b in own]
            gains[entry.effect.name] = max(e.gain if e.physical else -np.inf for e in estimates)
        winners.append(max(gains, key=lambda name: gains[name]) if gains else "")
    return winners


def cosine(directions: Directions, a: Screened, b: Screened) -> float:
    """Alignment of two effects' best signatures after the projections, pooled over scans."""
    name = next((s.projection for s in (a, b) if s.projection != "full"), "full")
    freed = freed_grams(directions, name, np.arange(len(directions.pixels)))
    pooled = freed[:, 1:, 1:].sum(axis=0)
    inner = a.signature @ pooled @ b.signature
    return float(inner / np.sqrt((a.signature @ pooled @ a.signature) * (b.signature @ pooled @ b.signature)))


def _scores(freed: np.ndarray, column: int) -> np.ndarray:
    """Score of each scan in units of its noise: scans differ in how much of a feature they hold."""
    information = freed[:, column, column]
    smallest = 1e-6 * max(information.max(), np.finfo(float).tiny)
    return freed[:, 0, column] / np.sqrt(np.maximum(information, smallest))


def _screen_one(
    effect: Effect,
    own: list[Block],
    directions: Directions,
    free: Mapping[str, np.ndarray],
    projection: Sequence[str],
    z: np.ndarray,
    null_max: np.ndarray,
    fold_of: np.ndarray,
) -> Screened:
    everything = np.arange(len(fold_of))
    chosen = projection[own[0].columns[0]]
    estimates = [_estimate(free[chosen], block, everything) for block in own]
    best = max(range(len(own)), key=lambda i: (estimates[i].physical, estimates[i].gain))
    block, multiples = own[best], estimates[best].multiples
    columns = [c for b in own for c in b.columns]
    strongest = float(z[max(columns, key=lambda c: abs(z[c]))])
    signature = np.zeros(free[chosen].shape[1] - 1)
    signature[list(block.columns)] = multiples
    raw = raw_information(directions)
    retained = max(float(free[chosen][:, 1 + c, 1 + c].sum() / max(raw[c], 1e-300)) for c in block.columns)
    return Screened(
        effect=effect,
        block=block,
        values=block.values(multiples),
        z=strongest,
        p=family_wise_p(strongest, null_max),
        gain_nm2=_held_out_gain(directions, own, chosen, fold_of),
        signature=signature,
        projection=chosen,
        in_range=estimates[best].physical,
        retained=retained,
        beside_base=_beside_base(directions, block, raw),
        detectable=_detectable(block, free[chosen], float(np.quantile(null_max, 1 - FAMILY_P))),
    )


def _beside_base(directions: Directions, block: Block, raw: np.ndarray) -> float:
    """Share of a block's information that the best projection leaves, base parameters aside."""
    grams = [directions.grams[name] for name in PROJECTIONS]
    columns = [(c, 1 + directions.parameters + c) for c in block.columns]
    return max(float(g[:, at, at].sum() / max(raw[c], 1e-300)) for g in grams for c, at in columns)


def _held_out_gain(
    directions: Directions, own: Sequence[Block], projection: str, fold_of: np.ndarray
) -> np.ndarray:
    gain = np.zeros(len(fold_of))
    for fold in range(int(fold_of.max()) + 1):
        training, held_out = np.flatnonzero(fold_of != fold), np.flatnonzero(fold_of == fold)
        freed = freed_grams(directions, projection, training)
        estimates = [_estimate(freed, block, training) for block in own]
        allowed = [i for i in range(len(own)) if estimates[i].physical]
        if not allowed:
            continue
        best = max(allowed, key=lambda i: estimates[i].gain)
        multiples, columns = estimates[best].multiples, [1 + c for c in own[best].columns]
        for scan in held_out:
            score = freed[scan][0, columns]
            information = freed[scan][np.ix_(columns, columns)]
            gain[scan] = (2 * multiples @ score - multiples @ information @ multiples) / directions.pixels[
                scan
            ]
    return gain * 1e6


class Estimate(NamedTuple):
    """One-step multiples of a block's trials, the gain they promise in the sum of squares (µm²), and
    whether their signs are physical."""

    multiples: np.ndarray
    gain: float
    physical: bool


def _estimate(freed: np.ndarray, block: Block, scans: np.ndarray) -> Estimate:
    columns = [1 + c for c in block.columns]
    score = freed[scans][:, 0, columns].sum(axis=0)
    information = freed[scans][:, columns][:, :, columns].sum(axis=0)
    multiples = np.linalg.lstsq(information, score, rcond=1e-8)[0]
    physical = _is_physical(block, multiples)
    multiples = multiples * _shortening(block, multiples)
    return Estimate(multiples, float(2 * multiples @ score - multiples @ information @ multiples), physical)


def _is_physical(block: Block, multiples: np.ndarray) -> bool:
    """No amplitude on the wrong side of a null that bounds it, unless noise may have put it there."""
    values, weights, wrong = block.values(multiples), {}, []
    for name, parameter in _amplitudes(block).items():
        weights[name] = abs(values[name] - parameter.null) / abs(parameter.typical - parameter.null)
        low, high = values[name] < parameter.null, values[name] > parameter.null
        if (low and parameter.lower >= parameter.null) or (high and parameter.upper <= parameter.null):
            wrong.append(name)
    return not any(weights[name] > 0.3 * max(weights.values()) for name in wrong)


def _shortening(block: Block, multiples: np.ndarray) -> float:
    """Share of the step that stays within the physical range: a straight line from the null overshoots."""
    values, share = block.values(multiples), 1.0
    for name, parameter in _amplitudes(block).items():
        step = values[name] - parameter.null
        room = (parameter.upper if step > 0 else parameter.lower) - parameter.null
        if abs(room) < abs(step) and room != 0:
            share = min(share, room / step)
    return share


def _amplitudes(block: Block) -> dict[str, Parameter]:
    named = {name for trial in block.trials for name in trial}
    return {n: block.effect.parameters[n] for n in block.effect.amplitudes if n in named}


def _projection_of_columns(directions: Directions, free: Mapping[str, np.ndarray]) -> list[str]:
    """``full``, or without the per-scan term that would swallow the effect; one per effect."""
    chosen = [""] * sum(len(b.columns) for b in directions.blocks)
    for name in {b.effect.name for b in directions.blocks}:
        own = [c for b in directions.blocks if b.effect.name == name for c in b.columns]
        left = {kind: sum(float(free[kind][:, 1 + c, 1 + c].sum()) for c in own) for kind in PROJECTIONS}
        most = max(left, key=lambda kind: left[kind])
        for c in own:
            chosen[c] = most if left["full"] < SWALLOWED_SHARE * left[most] else "full"
    return chosen


def _detectable(block: Block, freed: np.ndarray, critical: float) -> str:
    """Smallest amplitude that the screening would call, from the spread of the scores over scans."""
    column, name = 1 + block.columns[0], next(iter(set(block.trials[0]) & set(block.effect.amplitudes)))
    scores, information = freed[:, 0, column], freed[:, column, column].sum()
    spread = np.sqrt(len(scores) * np.var(scores, ddof=1)) if len(scores) > 1 else np.inf
    parameter = block.effect.parameters[name]
    size = critical * spread / max(information, 1e-300) * abs(block.trials[0][name] - parameter.null)
    return f"{name} {size:.2g} {parameter.unit}".removesuffix(" 1")
