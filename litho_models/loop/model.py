"""The digital twin of a machine: a base model of the printer together with effects. The strength of an effect
is either the same in all scans or differs between groups of scans.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from statistics import fmean

import numpy as np
import torch
from torch import nn

from litho_data.foundation import Array
from litho_models.effects import Parameter, get_effect
from litho_models.effects.chain import EffectChain, Fields, Frame
from litho_models.effects.registry import in_forward_order
from litho_models.fitting.small_models import fitted_numbers, load_numbers, parameter_room
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms.grouped import ALL, label_of
from litho_models.simulator import is_small

Values = Mapping[str, Mapping[str, float]]
# A fitted value whose relative distance from a bound is smaller than this counts as lying on the bound.
_AT_BOUND = 1e-6


class FoldedBase(nn.Module):
    """A base with one trained model for each fold. Each scan is predicted by the model that was trained
    without the scans of its fold.

    Args:
        models: one model per fold, in the order of the folds. Each was trained without the scans of its fold.
            One more model, the last, was trained on all scans. It predicts scans that belong to no fold.
        fold_of: number of the fold of each scan, keyed by scan id.
    """

    def __init__(self, models: Sequence[nn.Module], fold_of: Mapping[str, int]):
        super().__init__()
        self.models = nn.ModuleList(models)
        self.fold_of = fold_of
        # The trained weights are used as they are. They are not converted into a frozen model, because this
        # would change their rounding.
        self.eval()

    def of_scan(self, scan_id: str) -> nn.Module:
        """Return the model that was trained without this scan. For a scan that belongs to no fold, return the
        model that was trained on all scans.
        """
        return self.models[self.fold_of.get(scan_id, -1)]


@dataclass(frozen=True)
class Slot:
    """Identifies one parameter of an effect in a model. It applies to the scans that have the label ``label``
    in the grouping ``by``, which are all scans if ``by`` is ``all``.
    """

    effect: str
    parameter: str
    by: str = ALL
    label: str = ""

    @property
    def facts(self) -> Parameter:
        """Return the catalogue's entry for this parameter."""
        return get_effect(self.effect).parameters[self.parameter]

    def is_of(self, scan: PreparedScan) -> bool:
        """Return whether the parameter applies to this scan."""
        return label_of(scan, self.by) == self.label


@dataclass(frozen=True)
class Twin:
    """A base model and effects with their parameter values. A fit changes only the numbers in ``vector``.

    Attributes:
        base: the base model of the printer. If it has few parameters, they are refitted together with the
            parameters of the effects.
        numbers: values of the fitted parameters of the base; empty if the base is not refitted.
        effects: the values of the parameters of all effects, in the order in which the effects were added.
            An amplitude that differs between groups of scans has one value per group.
        frames: whether an effect rotates with the scan (``scan``) or with the print (``print``), keyed by the
            name of the effect. Effects that are not listed use their default; see ``EffectChain``.
    """

    base: nn.Module
    numbers: Array
    effects: Mapping[Slot, float] = field(default_factory=dict)
    frames: Mapping[str, Frame] = field(default_factory=dict)

    @classmethod
    def bare(cls, base: nn.Module) -> Twin:
        """Make a twin without effects."""
        return cls(base, fitted_numbers(base).astype(np.float64) if is_refitted(base) else np.empty(0))

    @property
    def own(self) -> int:
        """Return the number of fitted parameters of the base, which come first in ``vector``."""
        return len(self.numbers)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the effects, in the order in which they act."""
        return tuple(in_forward_order(slot.effect for slot in self.effects))

    @cached_property
    def slots(self) -> list[Slot]:
        """Return one slot for each fitted parameter of an effect. The order is that of ``vector``, where the
        parameters of the effects follow the parameters of the base.
        """
        return [slot for slot in self.effects if slot.facts.kind != "choice"]

    @cached_property
    def vector(self) -> Array:
        """Return the values of all p fitted parameters: first those of the base, then those of the effects.
        The result has shape (p,).
        """
        return np.concatenate([self.numbers, [self.effects[slot] for slot in self.slots]])

    def at(self, vector: Array) -> Twin:
        """Return the same twin with the given values of all fitted parameters."""
        fitted = zip(self.slots, vector[self.own :].tolist(), strict=True)
        return replace(self, numbers=vector[: self.own], effects={**self.effects, **dict(fitted)})

    def with_effect(self, name: str, by: str, values: Values) -> Twin:
        """Return the twin with a further effect. ``by`` is ``all`` if its strength is the same in all scans,
        and otherwise the name of the grouping with one strength per group. ``values`` contains the starting
        values, keyed by group label (``""`` for ``all``). Only amplitudes may differ between the groups.
        """
        added = {
            Slot(name, key, by, label) if facts.kind == "amplitude" else Slot(name, key): values[label][key]
            for key, facts in get_effect(name).parameters.items()
            for label in sorted(values)
        }
        return replace(self, effects={**self.without(name).effects, **added})

    def without(self, name: str) -> Twin:
        """Return the twin without the named effect."""
        return replace(self, effects={slot: own for slot, own in self.effects.items() if slot.effect != name})

    def with_effects(self, values: Values) -> Twin:
        """Return the twin with other effects, whose strengths are the same in all scans. ``values`` contains
        the values of all their parameters, keyed by the name of the effect.
        """
        return replace(
            self,
            effects={Slot(name, key): value for name, own in values.items() for key, value in own.items()},
        )

    def ungrouped(self) -> Twin:
        """Return a twin in which the strength of every effect is the same in all scans: each strength is
        replaced by its mean over the groups. The effects are in the order in which they act.
        """
        return self.with_effects(self.values())

    def values(self, scan: PreparedScan | None = None) -> dict[str, dict[str, float]]:
        """Return the parameter values of all effects in a scan, in the order in which the effects act. If a
        strength was not fitted for the group of the scan, or if no scan is given, the mean over the fitted
        groups is returned.
        """
        found: dict[str, dict[str, float]] = {name: {} for name in self.names}
        # The slots of a parameter in all groups follow one another.
        for (name, parameter), own in groupby(self.effects, lambda slot: (slot.effect, slot.parameter)):
            slots = [*own]
            known = [slot for slot in slots if scan and slot.is_of(scan)]
            found[name][parameter] = fmean(self.effects[slot] for slot in known or slots)
        return found

    def known_from(self, scans: Sequence[PreparedScan]) -> Twin:
        """Return the twin with only the parameters that the given scans determine. The strengths of groups to
        which none of these scans belongs are left out. In such a group, a strength is the mean over the
        remaining groups; if no group remains, the effect does nothing.
        """
        return replace(
            self, effects={slot: own for slot, own in self.effects.items() if any(map(slot.is_of, scans))}
        )

    @cached_property
    def fitted_base(self) -> nn.Module:
        """Return the base with its fitted parameters. If the base has fitted parameters, the result is a copy
        of it.
        """
        if not self.own:
            return self.base
        base = copy.deepcopy(self.base)
        load_numbers(base, self.numbers)
        return base

    def chain(self, scan: PreparedScan | None = None, extra: Values | None = None) -> EffectChain:
        """Return the base and the effects as a chain that predicts one scan. If no scan is given, strengths
        that differ by group are replaced by their means over the groups, and a base that was trained once for
        each fold by its model of all scans. ``extra`` contains the parameter values of a further effect to
        try, keyed by the name of the effect.
        """
        base = self.fitted_base
        if isinstance(base, FoldedBase):
            base = base.of_scan(scan.id if scan else "")
        return EffectChain(base, {**self.values(scan), **(extra or {})}, self.frames)

    @torch.no_grad()
    def height(self, scan: PreparedScan, extra: Values | None = None, known: Fields | None = None) -> Array:
        """Return the predicted height of the print in a scan, µm, of shape (ny, nx).

        Args:
            scan: the scan.
            extra: parameter values of a further effect to try, keyed by the name of the effect.
            known: cache of intermediate fields of this scan. Twins with the same base can share it. Newly
                computed fields are added to it.
        """
        chain, context = self.chain(scan, extra), scan.context
        return chain(context.layout_um, context, known, self.numbers.tobytes())[0, 0].numpy()

    def steps(self) -> Array:
        """Return the step by which each parameter is changed to compute a difference quotient. A step is
        negative only if the parameter is near its upper bound. The result has shape (p,).
        """
        steps = [5e-3 * max(abs(number), 0.2) for number in self.numbers.tolist()]
        for slot in self.slots:
            facts = slot.facts
            # A parameter that is usually zero, such as an angle, gets a tenth of its range as its usual size.
            size = 0.05 * (abs(facts.typical - facts.null) or 0.1 * (facts.upper - facts.lower))
            steps.append(size if self.effects[slot] + size <= facts.upper else -size)
        return np.array(steps)

    def room(self) -> tuple[Array, Array]:
        """Return two arrays of shape (p,): the lowest and the highest allowed step of each parameter. Steps
        within these limits keep the parameters of the base and of the effects within their ranges.
        """
        base = parameter_room(self.base, self.numbers) if self.own else np.empty((2, 0))
        ends = np.reshape([(slot.facts.lower, slot.facts.upper) for slot in self.slots], (-1, 2)).T
        lowest, highest = np.hstack([base, ends - self.vector[self.own :]])
        return np.minimum(lowest, 0), np.maximum(highest, 0)

    def free(self) -> Array:
        """Return a mask of the fitted parameters that do not lie on a bound. The mask has shape (p,)."""
        lowest, highest = self.room()
        return (lowest < -_AT_BOUND) & (highest > _AT_BOUND)

    def lengths_at_limits(self, name: str) -> str:
        """Return the names, separated by commas, of the lengths of an effect, such as ranges and depths, that
        lie on a limit of their range.
        """
        found = []
        for slot in self.slots:
            facts, value = slot.facts, self.effects[slot]
            at_limit = np.isclose(value, (facts.lower, facts.upper), _AT_BOUND, _AT_BOUND).any()
            if slot.effect == name and facts.kind == "shape" and facts.unit in ("µm", "px") and at_limit:
                found.append(slot.parameter)
        return ", ".join(found)


def is_refitted(base: nn.Module) -> bool:
    """Return whether the base has few enough parameters to be fitted together with the effects."""
    fixed = isinstance(base, FoldedBase) or not is_small(base)
    return not fixed and any(p.requires_grad for p in base.parameters())
