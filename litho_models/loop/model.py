"""The digital twin of a machine: a base model of the printer together with effects. The strength of an effect
is either the same in all scans or differs between groups of scans.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import nn

from litho_models.effects import Parameter, get_effect
from litho_models.effects.chain import EffectChain, Fields, Frame
from litho_models.effects.effect import Kind
from litho_models.effects.registry import in_forward_order
from litho_models.fitting.small_models import fitted_numbers, load_numbers, parameter_room
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms.grouped import ALL, label_of
from litho_models.simulator import Simulator, is_small

Values = Mapping[str, Mapping[str, float]]
# A fitted value whose relative distance from a bound is smaller than this counts as lying on the bound.
_AT_BOUND = 1e-6


class FoldedBase(nn.Module):
    """A base with one trained model for each fold. Each scan is predicted by the model that was trained
    without the scans of its fold.

    Args:
        models: one model per fold, in the order of the folds. Each was trained without the scans of its fold.
        fold_of: number of the fold of each scan, keyed by scan id.
        common: model that predicts scans that belong to no fold.
    """

    def __init__(self, models: Sequence[nn.Module], fold_of: Mapping[str, int], common: nn.Module):
        super().__init__()
        self.models = nn.ModuleList(models)
        self.common = common
        self.fold_of = dict(fold_of)
        # The trained weights are used as they are. They are not converted into a frozen model, because this
        # would change their rounding.
        self.eval()

    def of_scan(self, scan_id: str) -> nn.Module:
        """Return the model that was trained without this scan. For a scan that belongs to no fold, return the
        common model.
        """
        fold = self.fold_of.get(scan_id)
        return self.common if fold is None else self.models[fold]


@dataclass(frozen=True)
class Slot:
    """Identifies one fitted parameter of an effect. ``label`` is the label of the group of scans to which the
    parameter applies, or None if the parameter applies to all scans.
    """

    effect: str
    parameter: str
    label: str | None

    @property
    def facts(self) -> Parameter:
        """Return the catalogue's entry for this parameter."""
        return get_effect(self.effect).parameters[self.parameter]


@dataclass(frozen=True)
class Added:
    """The parameters of an effect in a model.

    ``by`` is ``all`` if the amplitudes of the effect are the same in all scans, and otherwise the name of the
    grouping with one set of amplitudes per group. ``values`` contains the parameter values of each group,
    keyed by the label of the group. If ``by`` is ``all``, the only label is ``""``.
    """

    by: str
    values: Values

    def of(self, label: str | None) -> dict[str, float]:
        """Return the parameter values of the group with this label. If this group was not fitted, or if the
        label is None, return the mean over the fitted groups.
        """
        if label is not None and label in self.values:
            return dict(self.values[label])
        first = next(iter(self.values.values()))
        return {key: float(np.mean([own[key] for own in self.values.values()])) for key in first}


@dataclass(frozen=True)
class Twin:
    """A base model and effects with their parameter values. A fit changes only the numbers in ``vector``.

    Attributes:
        base: the base model of the printer. If it has few parameters, they are refitted together with the
            parameters of the effects.
        numbers: values of the fitted parameters of the base; empty if the base is not refitted.
        effects: the parameter values of the effects, keyed by the name of the effect, in the order in which
            the effects were added.
        frames: whether an effect rotates with the scan (``scan``) or with the print (``print``), keyed by the
            name of the effect. Effects that are not listed use their default; see ``EffectChain``.
    """

    base: nn.Module
    numbers: np.ndarray
    effects: Mapping[str, Added] = field(default_factory=dict)
    frames: Mapping[str, Frame] = field(default_factory=dict)

    @classmethod
    def bare(cls, base: nn.Module) -> Twin:
        """Make a twin without effects."""
        return cls(base, _numbers(base))

    @property
    def own(self) -> int:
        """Return the number of fitted parameters of the base, which come first in ``vector``."""
        return len(self.numbers)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the effects, in the order in which they act."""
        return tuple(in_forward_order(self.effects))

    @cached_property
    def slots(self) -> list[Slot]:
        """Return one slot for each fitted parameter of an effect. The order is that of ``vector``, where the
        parameters of the effects follow the parameters of the base.
        """
        return [
            Slot(name, key, label)
            for name, one in self.effects.items()
            for key, facts in get_effect(name).parameters.items()
            if facts.kind != "choice"
            for label in (sorted(one.values) if facts.kind == "amplitude" and one.by != ALL else [None])
        ]

    @cached_property
    def vector(self) -> np.ndarray:
        """Return the values of all p fitted parameters: first those of the base, then those of the effects.
        The result has shape (p,).
        """
        of_slots = [self.effects[one.effect].of(one.label)[one.parameter] for one in self.slots]
        return np.concatenate([self.numbers, of_slots])

    def at(self, vector: np.ndarray) -> Twin:
        """Return the same twin with the given values of all fitted parameters."""
        values = {name: {label: one.of(label) for label in one.values} for name, one in self.effects.items()}
        for slot, number in zip(self.slots, vector[self.own :].tolist(), strict=True):
            own = values[slot.effect]
            for label in own if slot.label is None else [slot.label]:
                own[label][slot.parameter] = number
        effects = {name: replace(one, values=values[name]) for name, one in self.effects.items()}
        return replace(self, numbers=vector[: self.own], effects=effects)

    def of_fold(self, fold: int) -> Twin:
        """Return the twin that predicts the scans of a fold. If one base was trained for each fold, the twin
        gets the base that was trained without this fold. Otherwise, the twin is returned unchanged.
        """
        base = self.base
        return replace(self, base=base.models[fold]) if isinstance(base, FoldedBase) else self

    def with_effect(self, name: str, by: str, values: Values) -> Twin:
        """Return the twin with a further effect. ``by`` is ``all`` if its strength is the same in all scans,
        and otherwise the name of the grouping with one strength per group. ``values`` contains the starting
        values, keyed by group label (``""`` for ``all``).
        """
        return replace(self, effects={**self.effects, name: Added(by, values)})

    def without(self, name: str) -> Twin:
        """Return the twin without the named effect."""
        return replace(self, effects={other: one for other, one in self.effects.items() if other != name})

    def ungrouped(self) -> Twin:
        """Return a twin in which the strength of every effect is the same in all scans: each strength is
        replaced by its mean over the groups. The effects are in the order in which they act.
        """
        effects = {name: Added(ALL, {"": values}) for name, values in self.values().items()}
        return replace(self, effects=effects)

    def with_base_unfitted(self) -> Twin:
        """Return the twin with the default parameters of the base instead of the fitted ones."""
        if not (self.own and isinstance(self.base, Simulator)):
            return self
        return replace(self, numbers=_numbers(type(self.base)(self.base.config)))

    def values(self, label_in: Mapping[str, str] = {}) -> dict[str, dict[str, float]]:
        """Return the parameter values of all effects for scans with the given labels. If no label is given
        for a grouping, the mean over its groups is used. The effects are in the order in which they act.

        Args:
            label_in: label of the scans in each grouping, keyed by the name of the grouping.
        """
        return {name: self.effects[name].of(label_in.get(self.effects[name].by)) for name in self.names}

    def is_of(self, slot: Slot, scan: PreparedScan) -> bool:
        """Return whether a parameter applies to this scan. Each parameter applies to all scans or to one
        group of scans.
        """
        return slot.label in (None, label_of(scan.stored, self.effects[slot.effect].by))

    def known_from(self, scans: Sequence[PreparedScan]) -> Twin:
        """Replace the strengths that the given scans do not determine, and return the new twin. The strengths
        of the groups to which these scans belong are kept. The strengths of all other groups are replaced by
        the means of the kept strengths. If no strength of an effect is kept, its strengths are set to their
        null values, at which the effect does nothing.
        """
        effects = {}
        for name, one in self.effects.items():
            seen = {label_of(scan.stored, one.by) for scan in scans}
            known = {label: own for label, own in one.values.items() if label in seen}
            known = known or {"": get_effect(name).with_values({})}
            effects[name] = replace(
                one, values={label: Added(one.by, known).of(label) for label in one.values}
            )
        return replace(self, effects=effects)

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
        that differ by group are replaced by their means over the groups. ``extra`` contains the parameter
        values of a further effect to try, keyed by the name of the effect.
        """
        base, labels = self.fitted_base, dict[str, str]()
        if scan is not None:
            labels = {one.by: label_of(scan.stored, one.by) for one in self.effects.values()}
            base = base.of_scan(scan.id) if isinstance(base, FoldedBase) else base
        return EffectChain(base, {**self.values(labels), **(extra or {})}, self.frames)

    @torch.no_grad()
    def height(
        self, scan: PreparedScan, extra: Values | None = None, known: Fields | None = None
    ) -> np.ndarray:
        """Return the predicted height of the print in a scan, µm, of shape (ny, nx).

        Args:
            scan: the scan.
            extra: parameter values of a further effect to try, keyed by the name of the effect.
            known: cache of intermediate fields of this scan. Twins with the same base can share it. Newly
                computed fields are added to it.
        """
        chain, context = self.chain(scan, extra), scan.context
        return chain(context.layout_um, context, known, self.numbers.tobytes())[0, 0].numpy()

    def steps(self) -> np.ndarray:
        """Return the step by which each parameter is changed to compute a difference quotient. A step is
        negative only if the parameter is near its upper bound. The result has shape (p,).
        """
        _, upper, usual = self._ranges()
        own, size = self.vector[: self.own], 0.05 * usual
        effects = np.where(self.vector[self.own :] + size <= upper, size, -size)
        return np.concatenate([5e-3 * np.maximum(np.abs(own), 0.2), effects])

    def room(self) -> tuple[np.ndarray, np.ndarray]:
        """Return two arrays of shape (p,): the lowest and the highest allowed step of each parameter. Steps
        within these limits keep the parameters of the base and of the effects within their ranges.
        """
        lower, upper, _ = self._ranges()
        own, effects = self.vector[: self.own], self.vector[self.own :]
        lowest, highest = parameter_room(self.base, own) if self.own else (own, own)
        return (
            np.minimum(np.concatenate([lowest, lower - effects]), 0),
            np.maximum(np.concatenate([highest, upper - effects]), 0),
        )

    def _ranges(self) -> np.ndarray:
        """Return three numbers for each fitted parameter of an effect: its lower bound, its upper bound and
        its usual size. The result has shape (3, slots).
        """
        known = [
            # A parameter that is usually zero, such as an angle, gets a tenth of its range as its usual size.
            (one.lower, one.upper, abs(one.typical - one.null) or 0.1 * (one.upper - one.lower))
            for one in (slot.facts for slot in self.slots)
        ]
        return np.array(known).reshape(-1, 3).T

    def free(self) -> np.ndarray:
        """Return a mask of the fitted parameters that do not lie on a bound. The mask has shape (p,)."""
        lowest, highest = self.room()
        return (lowest < -_AT_BOUND) & (highest > _AT_BOUND)

    def at_limits(self, name: str, kind: Kind) -> str:
        """Return the names, separated by commas, of the parameters of an effect that lie on a limit of their
        range in at least one group. If ``kind`` is ``amplitude``, only amplitudes are examined, and the null
        value of an amplitude does not count as a limit. If ``kind`` is ``shape``, only lengths, such as
        ranges and depths, are examined.
        """
        found: dict[str, None] = {}
        for slot, value in zip(self.slots, self.vector[self.own :].tolist(), strict=True):
            facts = slot.facts
            counts = kind == "amplitude" or facts.unit in ("µm", "px")
            if slot.effect == name and facts.kind == kind and counts:
                limits = {facts.lower, facts.upper} - ({facts.null} if kind == "amplitude" else set())
                if any(abs(value - limit) < _AT_BOUND * max(1.0, abs(limit)) for limit in limits):
                    found[slot.parameter] = None
        return ", ".join(found)


def is_refitted(base: nn.Module) -> bool:
    """Return whether the base has few enough parameters to be fitted together with the effects."""
    trainable = any(p.requires_grad for p in base.parameters())
    return trainable and is_small(base) and not isinstance(base, FoldedBase)


def _numbers(base: nn.Module) -> np.ndarray:
    return fitted_numbers(base).astype(np.float64) if is_refitted(base) else np.empty(0)
