"""Rivals fitted to the same prints, so that none loses for where its fit began.

The base's numbers have more than one optimum: a fit with an almost straight projection ends elsewhere than
one with a steep one. Two effects that do the same, one fitted from each, then differ by several nm² on new
layouts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_models.fitting.least_squares import LeastSquaresFit, eliminated_sum, fit_least_squares
from litho_models.loop.fits import RULES, TwinProblem
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan


def fit_rivals(twins: Sequence[Twin], windows: Sequence[PreparedScan]) -> list[LeastSquaresFit]:
    """Each twin fitted from where it stands, and from the base's numbers of the best one."""

    def fitted(twin: Twin) -> LeastSquaresFit:
        return fit_least_squares(TwinProblem(twin, windows), twin.vector, RULES)

    def squares(fit: LeastSquaresFit) -> float:
        return eliminated_sum(fit.linear, RULES.term_weight)[2]

    fits = [fitted(twin) for twin in twins]
    best = min(fits, key=squares)
    base = best.vector[: twins[0].own]
    return [
        fit
        if fit is best or not len(base)
        else min(fit, fitted(twin.at(np.concatenate([base, fit.vector[len(base) :]]))), key=squares)
        for twin, fit in zip(twins, fits, strict=True)
    ]
