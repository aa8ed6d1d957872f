"""Rivals fitted to the same prints, so that none loses for where its fit began.

The base's numbers have more than one optimum: a fit with an almost straight projection ends elsewhere than
one with a steep one. Two effects that do the same, one fitted from each, then differ by several nm² on new
layouts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_models.effects.chain import EffectChain
from litho_models.fitting.least_squares import eliminated_sum, fit_least_squares
from litho_models.loop.fold_fits import RULES, TERM_WEIGHT, ChainProblem
from litho_models.loop.prepared import PreparedScan


def fit_rivals(
    chains: Sequence[EffectChain], starts: Sequence[np.ndarray], windows: Sequence[PreparedScan]
) -> list[np.ndarray]:
    """The numbers (p,) of each chain, fitted from its own start and from the base's numbers of the best one.

    Args:
        chains: of one base; ``starts``: (p,) for each, the base's numbers first.
        windows: what the fits see.
    """
    shared = len(starts[0]) - len(chains[0].fitted)

    def fitted(number: int, start: np.ndarray) -> tuple[float, np.ndarray]:
        fit = fit_least_squares(ChainProblem(chains[number], windows), start, RULES["squares"])
        return eliminated_sum(fit.linear, TERM_WEIGHT)[2], fit.vector

    found = [fitted(number, start) for number, start in enumerate(starts)]
    given: set[int] = set()
    while shared and (best := min(range(len(found)), key=lambda i: found[i][0])) not in given:
        given.add(best)
        base = found[best][1][:shared]
        for number, (squares, vector) in enumerate(found):
            if number != best:
                again = fitted(number, np.concatenate([base, vector[shared:]]))
                found[number] = again if again[0] < squares else found[number]
    return [vector for _, vector in found]
