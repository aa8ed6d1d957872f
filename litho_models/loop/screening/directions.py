"""What each effect changes at its null: secant directions, their inner products with the residual."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from litho_models.effects import Effect
from litho_models.effects.chain import EffectChain
from litho_models.fitting.least_squares import gram_inside
from litho_models.loop.fold_fits import FoldFits
from litho_models.loop.linear import ALL_FREE, free_basis
from litho_models.loop.parameters import model_for
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms import Terms

PROJECTIONS: Mapping[str, Terms] = {
    "full": ALL_FREE,
    "no-gain": ALL_FREE - {"gain"},
    "no-bow": ALL_FREE - {"bow"},
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
    fits: FoldFits,
    scans: Sequence[PreparedScan],
    residuals: Sequence[np.ndarray],
    effects: Sequence[Effect],
) -> Directions:
    """Secants of all trials and their inner products with the residual, for each scan.

    Args:
        fits: the model so far.
        scans: scans; ``residuals``: out-of-fold residual (n,) µm at the sampled pixels.
        effects: candidates, none of them in the chain.
    """
    chain, linear = fits.chain, fits.linear
    blocks = blocks_of(effects)
    extended = [chain.with_effects(_with_trial(chain, b, t)) for b in blocks for t in b.trials]
    acts_on = [b.effect.acts_on for b in blocks for _ in b.trials]
    stacked: dict[str, list[np.ndarray]] = {name: [] for name in ("raw", *PROJECTIONS)}
    for scan, part, residual in zip(scans, linear, residuals, strict=True):
        prediction, secants = _secants(chain, extended, acts_on, scan)
        columns = np.column_stack([residual, part.jacobian.T, *secants])
        raw = columns.T @ columns
        stacked["raw"].append(raw)
        for name, terms in PROJECTIONS.items():
            basis = free_basis(scan, prediction, terms)
            stacked[name].append(raw - gram_inside(columns, basis))
    return Directions(
        blocks=blocks,
        grams={name: np.stack(grams) for name, grams in stacked.items()},
        parameters=len(linear[0].jacobian),
        pixels=np.array([len(scan.sample) for scan in scans]),
    )


def freed_grams(directions: Directions, projection: str, scans: np.ndarray) -> np.ndarray:
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


def raw_information(directions: Directions) -> np.ndarray:
    start = 1 + directions.parameters
    return np.einsum("fii->i", directions.grams["raw"])[start:]


def _with_trial(
    chain: EffectChain, block: Block, trial: Mapping[str, float]
) -> dict[str, Mapping[str, float]]:
    return {**chain.values(), block.effect.name: block.effect.with_values(trial)}


def _secants(
    chain: EffectChain, extended: Sequence[EffectChain], acts_on: Sequence[str], scan: PreparedScan
) -> tuple[np.ndarray, list[np.ndarray]]:
    with torch.no_grad():
        before = model_for(chain.base, scan.id)(chain.before_base(scan.layout, scan.context))
        here = chain.after_base(before, scan.context)
        secants = []
        for other, where in zip(extended, acts_on, strict=True):
            if where == "height":
                moved = other.after_base(before, scan.context)
            else:
                base = model_for(other.base, scan.id)
                moved = other.after_base(base(other.before_base(scan.layout, scan.context)), scan.context)
            secants.append(scan.at_sample(moved - here))
    return here[0, 0].numpy(), secants
