"""A fitted model and what it foretells of the scans that each of its fits has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from litho_models.effects.chain import EffectChain
from litho_models.loop.fitting import FoldFits, fit_folds, predict
from litho_models.loop.prepared import Field


@dataclass(frozen=True)
class State:
    """A fitted model and its held-out predictions (y, x) µm, one per scan."""

    fits: FoldFits
    predictions: list[np.ndarray]


def fit_state(chain: EffectChain, fields: Sequence[Field], fold_of: np.ndarray) -> State:
    """Fit the chain per fold and predict every scan with the fit that has not seen it."""
    fits = fit_folds(chain, [field.window for field in fields], fold_of)
    return State(fits, [predict(fits.chain, fits.per_fold[fold_of[i]], f) for i, f in enumerate(fields)])


def held_out_residuals(state: State, windows: Sequence[Field], fold_of: np.ndarray) -> list[np.ndarray]:
    """Measured minus predicted (n,) µm at the sampled pixels, each scan by the fit that has not seen it."""
    fits = state.fits
    return [
        w.height - w.at_sample(predict(fits.chain, fits.per_fold[fold], w))
        for w, fold in zip(windows, fold_of, strict=True)
    ]
