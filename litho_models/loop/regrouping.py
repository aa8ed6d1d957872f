"""Whether the strength of a fitted effect differs by group.

The derivative where the effect stands says more than the one at its null, by which it was screened.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from litho_models.loop.fits import State, Study, without_terms
from litho_models.loop.judging import EXCHANGED_P
from litho_models.loop.model import Twin
from litho_models.loop.screening import gains_by, permutation_p
from litho_models.scan_terms.grouped import ALL, Block, Labels, Products

# Of groupings that do nearly as well the one with the fewest labels is taken.
NEARLY = 0.95


def regrouped(state: State, name: str, study: Study) -> tuple[str, float, Twin] | None:
    """The grouping by which an effect's strength differs beyond chance, its p, and a twin to fit from there.

    None where no grouping gains on held-out scans, or chance does as well.
    """
    twin = state.twin
    amplitudes = [
        at
        for at, slot in enumerate(twin.slots, twin.own)
        if slot.effect == name and slot.facts.kind == "amplitude"
    ]
    columns = [1 + at for at in amplitudes]
    freed = _freed(state, study, amplitudes)

    def gains(labels: Labels) -> np.ndarray:
        return gains_by(freed, study.fold_of, columns, labels)[0]

    by_group = {by: float(gains(labels).mean()) for by, labels in study.groups.items() if by != ALL}
    most = max(by_group.values(), default=0.0)
    if most <= 0:
        return None
    close = [by for by, gain in by_group.items() if gain >= NEARLY * most]
    best = min(close, key=lambda by: (len(set(study.groups[by])), -by_group[by]))
    p = permutation_p(study, study.groups[best], by_group[best], gains)
    if p > EXCHANGED_P:
        return None
    steps = gains_by(freed, study.fold_of, columns, study.groups[best])[1]
    return best, p, _started(twin, name, best, dict(zip(amplitudes, _by_number(steps), strict=True)))


def _freed(state: State, study: Study, amplitudes: Sequence[int]) -> np.ndarray:
    """Inner products of residual and derivatives, free of single scans and of the model's other numbers."""
    placed, grams = state.twin.placed(), []
    for window, part, left in zip(study.windows, state.linear, state.held_out_um, strict=True):
        rows = without_terms(np.column_stack([left, *part.jacobian]), window, placed.height(window))
        grams.append(rows.T @ rows / len(rows))
    others = [Block((1 + at,)) for at in range(len(state.twin.vector)) if at not in amplitudes]
    return Products(np.stack(grams), study.groups).freed_of(others).grams


def _by_number(steps: Mapping[str, np.ndarray]) -> list[dict[str, float]]:
    return [dict(zip(steps, row, strict=True)) for row in np.array([*steps.values()]).T.tolist()]


def _started(twin: Twin, name: str, by: str, steps: Mapping[int, Mapping[str, float]]) -> Twin:
    """The twin with the effect's amplitudes by group, each a step from where they all stand."""
    known = twin.values({})[name]
    labels = {label for own in steps.values() for label in own}
    starts = {label: dict(known) for label in labels}
    for at, own in steps.items():
        slot = twin.slots[at - twin.own]
        for label, step in own.items():
            value = known[slot.parameter] + step
            starts[label][slot.parameter] = min(max(value, slot.facts.lower), slot.facts.upper)
    return twin.without(name).with_effect(name, by, starts)
