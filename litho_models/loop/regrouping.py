"""By which groups of the scans a strength differs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from litho_models.loop.fits import State, Study
from litho_models.loop.judging import EXCHANGED_P
from litho_models.loop.model import Twin
from litho_models.loop.screening import Screening, gains_by, permutation_p
from litho_models.scan_terms.grouped import ALL, Labels


def best_grouping(gains: Mapping[str, float], numbers: Mapping[str, int]) -> str | None:
    """The grouping that gains most; of those that do nearly as well the one with the fewest numbers."""
    most = max(gains.values(), default=0.0)
    close = [by for by, gain in gains.items() if gain >= 0.95 * most > 0]
    return min(close, key=lambda by: (numbers[by], -gains[by]), default=None)


def regrouped(state: State, name: str, study: Study) -> tuple[str, float, Twin] | None:
    """The grouping by which an effect's strength differs beyond chance, its p, and a twin to fit from there.

    The derivative where the effect stands says more than the one at its null, by which it was screened. None
    where no grouping gains on held-out scans, or chance does as well.
    """
    twin = state.twin
    slots = {
        at: slot
        for at, slot in enumerate(twin.slots, twin.own)
        if slot.effect == name and slot.facts.kind == "amplitude"
    }
    freed = Screening(state, study, (), kept=slots).freed

    def gained(labels: Labels) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        return gains_by(freed, study.fold_of, [1 + at for at in slots], labels)

    groups = {by: labels for by, labels in study.groups.items() if by != ALL}
    gains = {by: float(gained(labels)[0].mean()) for by, labels in groups.items()}
    by = best_grouping(gains, {by: len(set(labels)) for by, labels in groups.items()})
    if by is None:
        return None
    p = permutation_p(study, groups[by], gains[by], lambda labels: gained(labels)[0])
    if p > EXCHANGED_P:
        return None
    known = twin.values({})[name]
    starts = {label: dict(known) for label in groups[by]}
    for label, steps in gained(groups[by])[1].items():
        for slot, step in zip(slots.values(), steps.tolist(), strict=True):
            value = known[slot.parameter] + step
            starts[label][slot.parameter] = min(max(value, slot.facts.lower), slot.facts.upper)
    return by, p, twin.without(name).with_effect(name, by, starts)
