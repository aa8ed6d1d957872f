"""How small an effect would be found here: plant it in copies of these scans and screen them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import Effect, get_effect, screened_effects
from litho_models.loop.linear import without_scan_terms
from litho_models.loop.screening.directions import measure_directions
from litho_models.loop.screening.eligibility import is_eligible
from litho_models.loop.screening.score_test import SAME_COSINE, best_by_fold, cosine, screen
from litho_models.loop.study import State, Study, held_out_residuals
from litho_models.scan_terms import Terms

MULTIPLES = (0.125, 0.25, 0.5, 1.0)
FOLDS_THAT_MUST_AGREE = 5 / 6


@dataclass(frozen=True)
class Planted:
    """One amount of one effect planted in copies of all scans.

    ``rms_nm``: what it changes, freed of per-scan terms. ``found``: it, or something with the same
    signature, stands out. ``power``: share of the training sets whose best candidate it is.
    """

    name: str
    amount: float
    unit: str
    rms_nm: float
    found: bool
    power: float
    best: str


def parse_injection(text: str) -> tuple[Effect, float]:
    """Effect and amount from ``NAME=AMOUNT``, the amount in the unit of its first amplitude.

    Raises:
        InputError: another form, an unknown effect, one that differs from scan to scan, or no number.
    """
    name, separator, number = text.partition("=")
    effect = get_effect(name.strip())
    try:
        amount = float(number)
    except ValueError:
        amount = float("nan")
    if not separator or not np.isfinite(amount):
        raise InputError("--inject", got=repr(text), wanted="NAME=AMOUNT, such as vignetting=0.1")
    if effect.per_scan:
        raise InputError("--inject", got=name, wanted="an effect with one value for all scans")
    return effect, amount


def plant(text: str, state: State, study: Study, terms: Terms) -> list[Planted]:
    """Screen copies of the scans with the effect at several parts of the stated amount."""
    effect, amount = parse_injection(text)
    amplitude = effect.amplitudes[0]
    parameter = effect.parameters[amplitude]
    fits = state.fits
    mse_nm2 = float(state.score(study, terms).mse_nm2.mean())
    candidates = [e for e in screened_effects() if e.name not in fits.chain.names]
    windows, held_out = study.windows, held_out_residuals(state, study)
    outcomes = []
    for multiple in MULTIPLES:
        value = parameter.null + multiple * (amount - parameter.null)
        values = {
            name: p.typical if p.kind != "amplitude" else p.null for name, p in effect.parameters.items()
        }
        planted_chain = fits.chain.with_effects(
            {**fits.chain.values(), effect.name: {**values, amplitude: value}}
        )
        residuals, squares = [], []
        for window, residual in zip(windows, held_out, strict=True):
            with torch.no_grad():
                here = fits.chain(window.layout, window.context)
                change = planted_chain(window.layout, window.context) - here
            added = window.at_sample(change)
            residuals.append(residual + added)
            freed = without_scan_terms(added, window, here[0, 0].numpy())
            squares.append(float(np.mean(freed**2)))
        directions = measure_directions(fits, windows, residuals, candidates)
        screened = screen(directions, study.fold_of)
        own = next(s for s in screened if s.effect.name == effect.name)
        eligible = [s for s in screened if is_eligible(s, mse_nm2)]
        alike = {s.effect.name for s in eligible if abs(cosine(directions, own, s)) >= SAME_COSINE}
        winners = best_by_fold(directions, eligible, study.fold_of) if eligible else []
        power = sum(winner in alike | {effect.name} for winner in winners) / study.folds
        outcomes.append(
            Planted(
                name=effect.name,
                amount=value,
                unit=parameter.unit,
                rms_nm=float(np.sqrt(np.mean(squares))) * NM_PER_UM,
                found=bool(alike) and power >= FOLDS_THAT_MUST_AGREE,
                power=power,
                best=eligible[0].effect.name if eligible else "",
            )
        )
    return outcomes
