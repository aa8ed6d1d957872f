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
import torch

from litho_models.effects import Effect
from litho_models.effects.chain import EffectChain
from litho_models.effects.effect import Parameter
from litho_models.loop.confirming import sign_flips
from litho_models.loop.fields import Field
from litho_models.loop.fitting import Linearisation, set_vector
from litho_models.loop.linear import gram_inside, nuisance_columns, orthonormal

FAMILY_P = 0.05
SAME_COSINE = 0.8
# Of a direction's information, what must survive the projections for a test to mean anything.
SMALLEST_RETAINED = 1e-5
# An effect of which a term of single scans leaves less than this is tested without that term.
SWALLOWED_SHARE = 0.05
_PROJECTIONS: Mapping[str, Mapping[str, bool]] = {
    "full": {"gain": True},
    "no-gain": {"gain": False},
    "no-bow": {"gain": True, "bow": False},
}


@dataclass(frozen=True)
class Block:
    """Trials of one effect that share shape and size; their amplitudes are fitted jointly."""

    effect: Effect
    shape: Mapping[str, float]
    columns: tuple[int, ...]
    trials: tuple[Mapping[str, float], ...]

    def values(self, multiples: np.ndarray) -> dict[str, float]:
        """Parameter values for the given multiples of the trials' amplitudes."""
        values = {**self.effect.off_values(), **self.shape}
        for multiple, trial in zip(multiples, self.trials, strict=True):
            for name in self.effect.amplitudes:
                if name in trial:
                    values[name] += float(multiple) * (trial[name] - self.effect.parameters[name].null)
        return values


@dataclass(frozen=True)
class Directions:
    """Inner products of all scans, ready for any subset of them.

    Attributes:
        blocks: trials by effect and shape; their columns count from 0.
        grams: per projection, and ``raw`` without any, an array (scans, 1 + p + m, 1 + p + m):
            residual, parameters of the model, directions.
        parameters: p.
        pixels: (scans,) sampled pixels.
    """

    blocks: list[Block]
    grams: dict[str, np.ndarray]
    parameters: int
    pixels: np.ndarray


@dataclass(frozen=True)
class Screened:
    """What the score test says of one effect.

    ``gain_nm2``: predicted gain in squared error of each scan, its amplitudes estimated without the
    scan's fold. ``signature``: multiples of the directions' columns of the best block.
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
    detectable: str

    @property
    def mean_gain_nm2(self) -> float:
        return float(self.gain_nm2.mean())


def blocks_of(effects: Sequence[Effect]) -> list[Block]:
    """Group the trials of the effects by shape and by size; number the columns.

    A second trial of the same amplitudes at the same shape is another size: what an effect does
    when it is large need not be a multiple of what it does when it is small.
    """
    blocks, column = [], 0
    for effect in effects:
        grouped: dict[tuple, list[Mapping[str, float]]] = {}
        for trial in effect.trials:
            shape = tuple(sorted((k, v) for k, v in trial.items() if k not in effect.amplitudes))
            names, size = set(trial), 0
            while any(set(other) == names for other in grouped.get((shape, size), [])):
                size += 1
            grouped.setdefault((shape, size), []).append(trial)
        for (shape, _), trials in grouped.items():
            columns = tuple(range(column, column + len(trials)))
            blocks.append(Block(effect, dict(shape), columns, tuple(trials)))
            column += len(trials)
    return blocks


def measure_directions(
    chain: EffectChain,
    vector: np.ndarray,
    linear: Sequence[Linearisation],
    fields: Sequence[Field],
    residuals: Sequence[np.ndarray],
    effects: Sequence[Effect],
) -> Directions:
    """Secants of all trials and their inner products with the residual, for each scan.

    Args:
        chain, vector: the model so far; ``linear``: its derivatives per scan.
        fields: scans; ``residuals``: out-of-fold residual (n,) µm at the sampled pixels.
        effects: candidates, none of them in the chain.
    """
    set_vector(chain, vector)
    blocks = blocks_of(effects)
    extended = [chain.with_effects(_with_trial(chain, b, t)) for b in blocks for t in b.trials]
    acts_on = [b.effect.acts_on for b in blocks for _ in b.trials]
    stacked: dict[str, list[np.ndarray]] = {name: [] for name in ("raw", *_PROJECTIONS)}
    for field, part, residual in zip(fields, linear, residuals, strict=True):
        prediction, secants = _secants(chain, extended, acts_on, field)
        columns = np.column_stack([residual, part.jacobian, *secants])
        raw = columns.T @ columns
        stacked["raw"].append(raw)
        for name, terms in _PROJECTIONS.items():
            basis = orthonormal(nuisance_columns(field, prediction, **terms))
            stacked[name].append(raw - gram_inside(columns, basis))
    return Directions(
        blocks=blocks,
        grams={name: np.stack(grams) for name, grams in stacked.items()},
        parameters=linear[0].jacobian.shape[1],
        pixels=np.array([len(field.sample) for field in fields]),
    )


def screen(directions: Directions, fold_of: np.ndarray) -> list[Screened]:
    """Test every effect, best predicted gain first.

    Args:
        directions: from ``measure_directions``.
        fold_of: (scans,) fold that holds each scan out.
    """
    everything = np.arange(len(fold_of))
    free = {name: _freed(directions, name, everything) for name in _PROJECTIONS}
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
        freed = {name: _freed(directions, name, training) for name in _PROJECTIONS}
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
    freed = _freed(directions, name, np.arange(len(directions.pixels)))
    pooled = freed[:, 1:, 1:].sum(axis=0)
    inner = a.signature @ pooled @ b.signature
    return float(inner / np.sqrt((a.signature @ pooled @ a.signature) * (b.signature @ pooled @ b.signature)))


def sign_flip_statistics(scores: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Cluster-robust z of each column of (scans, columns), and the null distribution of max |z|.

    z = sum s / sqrt(F/(F-1) sum (s - mean)²). The null flips scans, the same flip for all columns:
    see ``sign_flips``.
    """
    count = len(scores)
    signs = sign_flips(count, seed)
    sums = signs @ scores
    squares = (scores**2).sum(axis=0)
    # A column of equal scores would divide by zero; z is capped where the spread vanishes.
    spread = np.maximum(squares - sums**2 / count, 1e-6 * squares + np.finfo(float).tiny)
    z = sums / np.sqrt(count / max(count - 1, 1) * spread)
    return z[0], np.abs(z).max(axis=1)


def family_wise_p(z: float, null_max: np.ndarray) -> float:
    """Share of sign flips whose largest |z| reaches this one."""
    return float(np.mean(null_max >= abs(z) * (1 - 1e-9)))


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
    raw = _raw_information(directions)
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
        detectable=_detectable(block, free[chosen], float(np.quantile(null_max, 1 - FAMILY_P))),
    )


def _held_out_gain(
    directions: Directions, own: Sequence[Block], projection: str, fold_of: np.ndarray
) -> np.ndarray:
    gain = np.zeros(len(fold_of))
    for fold in range(int(fold_of.max()) + 1):
        training, held_out = np.flatnonzero(fold_of != fold), np.flatnonzero(fold_of == fold)
        freed = _freed(directions, projection, training)
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


def _freed(directions: Directions, projection: str, scans: np.ndarray) -> np.ndarray:
    """Grams (scans, 1 + m, 1 + m) of residual and directions, freed of the model's own parameters."""
    grams, p = directions.grams[projection], directions.parameters
    if not p:
        return grams
    pooled = grams[scans].sum(axis=0)
    own, rest = slice(1, 1 + p), np.r_[0, 1 + p : grams.shape[1]]
    scale = np.sqrt(np.maximum(np.diag(pooled)[own], 1e-300))
    normal = pooled[own, own] / np.outer(scale, scale)
    coefficients = (
        np.linalg.lstsq(normal, pooled[own][:, rest] / scale[:, None], rcond=1e-7)[0] / scale[:, None]
    )
    transform = np.zeros((grams.shape[1], len(rest)))
    transform[rest, np.arange(len(rest))] = 1
    transform[own] = -coefficients
    return transform.T @ grams @ transform


def _raw_information(directions: Directions) -> np.ndarray:
    start = 1 + directions.parameters
    return np.einsum("fii->i", directions.grams["raw"])[start:]


def _projection_of_columns(directions: Directions, free: Mapping[str, np.ndarray]) -> list[str]:
    """``full``, or without the per-scan term that would swallow the effect; one per effect."""
    chosen = [""] * sum(len(b.columns) for b in directions.blocks)
    for name in {b.effect.name for b in directions.blocks}:
        own = [c for b in directions.blocks if b.effect.name == name for c in b.columns]
        left = {kind: sum(float(free[kind][:, 1 + c, 1 + c].sum()) for c in own) for kind in _PROJECTIONS}
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


def _with_trial(
    chain: EffectChain, block: Block, trial: Mapping[str, float]
) -> dict[str, Mapping[str, float]]:
    return {**chain.values(), block.effect.name: block.effect.with_values(trial)}


def _secants(
    chain: EffectChain, extended: Sequence[EffectChain], acts_on: Sequence[str], field: Field
) -> tuple[np.ndarray, list[np.ndarray]]:
    with torch.no_grad():
        before = chain.base(chain.before_base(field.layout, field.context))
        here = chain.after_base(before, field.context)
        secants = []
        for other, where in zip(extended, acts_on, strict=True):
            if where == "height":
                moved = other.after_base(before, field.context)
            else:
                moved = other(field.layout, field.context)
            secants.append(field.at_sample(moved - here))
    return here[0, 0].numpy(), secants
