"""The twin: a base model with effects whose strengths are the same for all scans or differ by group."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import nn
from torch.nn.utils import vector_to_parameters

from litho_models.effects import Parameter, get_effect
from litho_models.effects.chain import EffectChain, Fields, Frame
from litho_models.effects.effect import Kind
from litho_models.effects.registry import in_forward_order
from litho_models.fitting.small_models import parameter_room
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms.grouped import ALL, label_of
from litho_models.simulator import Simulator, is_small

Values = Mapping[str, Mapping[str, float]]
# Relative distance from a bound below which a fitted value counts as on the bound.
_AT_BOUND = 1e-6


class FoldedBase(nn.Module):
    """One trained model per fold; each scan is predicted by the model that was trained without it.

    Args:
        models: one per fold; ``fold_of``: fold of each scan id; ``common``: model for scans in no fold.
    """

    def __init__(self, models: Sequence[nn.Module], fold_of: Mapping[str, int], common: nn.Module):
        super().__init__()
        self.models = nn.ModuleList(models)
        self.common = common
        self.fold_of = dict(fold_of)
        # Weights stay as trained, because freezing would change their rounding.
        self.eval()

    def of_fold(self, fold: int) -> nn.Module:
        """Return the model trained without this fold."""
        return self.models[fold]

    def of_scan(self, scan_id: str) -> nn.Module:
        """Return the model trained without this scan."""
        fold = self.fold_of.get(scan_id)
        return self.common if fold is None else self.models[fold]


@dataclass(frozen=True)
class Slot:
    """One fitted parameter of an effect; ``label`` is its group of scans, or None for all scans."""

    effect: str
    parameter: str
    label: str | None

    @property
    def facts(self) -> Parameter:
        """Return the catalogue's entry for this parameter."""
        return get_effect(self.effect).parameters[self.parameter]


@dataclass(frozen=True)
class Added:
    """An effect in a model.

    ``by`` is the grouping in which its amplitudes differ, or ``all`` for one strength. ``values`` contains
    its parameters by label, with ``""`` for all scans.
    """

    by: str
    values: Values

    def of(self, label: str | None) -> dict[str, float]:
        """Return the parameters of a group; for a group that was never fitted, return the mean over the
        fitted groups.
        """
        if label is not None and label in self.values:
            return dict(self.values[label])
        first = next(iter(self.values.values()))
        return {key: float(np.mean([own[key] for own in self.values.values()])) for key in first}


@dataclass(frozen=True)
class Twin:
    """A base model and effects with their parameters. Fits change only ``vector``.

    Attributes:
        base: the model of the printer; its parameters are refitted if they are few.
        numbers: fitted parameters of the base.
        effects: the effects by name, in the order in which they were added.
        frames: for each effect that does not use its default frame, the frame with which it rotates; see
            ``EffectChain``.
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
        """Return the number of fitted parameters of the base."""
        return len(self.numbers)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the effects, in the order in which they act."""
        return tuple(in_forward_order(self.effects))

    @cached_property
    def slots(self) -> list[Slot]:
        """Return the fitted parameters of the effects, in the order in which they follow the parameters of
        the base in ``vector``.
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
        """Return all fitted parameters, first those of the base."""
        of_slots = [self.effects[one.effect].of(one.label)[one.parameter] for one in self.slots]
        return np.concatenate([self.numbers, of_slots])

    def at(self, vector: np.ndarray) -> Twin:
        """Return the same twin with other parameters."""
        values = {name: {label: one.of(label) for label in one.values} for name, one in self.effects.items()}
        for slot, number in zip(self.slots, vector[self.own :].tolist(), strict=True):
            own = values[slot.effect]
            for label in own if slot.label is None else [slot.label]:
                own[label][slot.parameter] = number
        effects = {name: replace(one, values=values[name]) for name, one in self.effects.items()}
        return replace(self, numbers=vector[: self.own], effects=effects)

    def of_fold(self, fold: int) -> Twin:
        """Return the twin with the base that was trained without this fold, if there is such a base."""
        base = self.base
        return replace(self, base=base.of_fold(fold)) if isinstance(base, FoldedBase) else self

    def with_effect(self, name: str, by: str, values: Values) -> Twin:
        """Add an effect with starting values by label (``""`` for all scans)."""
        return replace(self, effects={**self.effects, name: Added(by, values)})

    def without(self, name: str) -> Twin:
        """Remove one effect."""
        return replace(self, effects={other: one for other, one in self.effects.items() if other != name})

    def ungrouped(self) -> Twin:
        """Replace the strengths of groups by their mean, and sort parameters in the order in which effects
        act.
        """
        effects = {name: Added(ALL, {"": values}) for name, values in self.values().items()}
        return replace(self, effects=effects)

    def with_base_unfitted(self) -> Twin:
        """Reset the base to its default values."""
        if not (self.own and isinstance(self.base, Simulator)):
            return self
        return replace(self, numbers=_numbers(type(self.base)(self.base.config)))

    def values(self, label_in: Mapping[str, str] = {}) -> dict[str, dict[str, float]]:
        """Return the parameter values of all effects, in the order in which they act, for scans with these
        labels; without labels, return mean strengths.
        """
        return {name: self.effects[name].of(label_in.get(self.effects[name].by)) for name in self.names}

    def is_of(self, slot: Slot, scan: PreparedScan) -> bool:
        """Return whether a parameter applies to this scan: it belongs to the scan's group or to all scans."""
        return slot.label in (None, label_of(scan.stored, self.effects[slot.effect].by))

    def known_from(self, scans: Sequence[PreparedScan]) -> Twin:
        """Keep the strengths of the groups to which these scans belong.

        Every other group gets the mean of the strengths that are kept.
        """
        effects = {}
        for name, one in self.effects.items():
            seen = {label_of(scan.stored, one.by) for scan in scans}
            known = {label: own for label, own in one.values.items() if label in seen}
            known = known or {"": get_effect(name).off_values()}
            effects[name] = replace(
                one, values={label: Added(one.by, known).of(label) for label in one.values}
            )
        return replace(self, effects=effects)

    @cached_property
    def fitted_base(self) -> nn.Module:
        """Return the base with its fitted parameters, as a copy if it has any."""
        if not self.own:
            return self.base
        base = copy.deepcopy(self.base)
        vector_to_parameters(torch.as_tensor(self.numbers, dtype=torch.float32), _parameters(base))
        return base

    def chain(self, scan: PreparedScan | None = None, extra: Values | None = None) -> EffectChain:
        """Return the chain of effects for one scan or, without a scan, with mean strengths; ``extra`` is a
        further effect to try.
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
        """Return the predicted height of the print (y, x), µm.

        Args:
            extra: a further effect to try.
            known: fields of this scan that twins with the same base have already computed. New fields are
                added.
        """
        chain, context = self.chain(scan, extra), scan.context
        return chain(context.layout_um, context, known, self.numbers.tobytes())[0, 0].numpy()

    def steps(self) -> np.ndarray:
        """Return the step of each parameter, (p,), for difference quotients. It is negative only near an
        upper limit.
        """
        _, upper, usual = self._ranges()
        own, size = self.vector[: self.own], 0.05 * usual
        effects = np.where(self.vector[self.own :] + size <= upper, size, -size)
        return np.concatenate([5e-3 * np.maximum(np.abs(own), 0.2), effects])

    def room(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and largest step (p,) that keep base and effects within their ranges."""
        lower, upper, _ = self._ranges()
        own, effects = self.vector[: self.own], self.vector[self.own :]
        lowest, highest = parameter_room(self.base, own) if self.own else (own, own)
        return (
            np.minimum(np.concatenate([lowest, lower - effects]), 0),
            np.maximum(np.concatenate([highest, upper - effects]), 0),
        )

    def _ranges(self) -> np.ndarray:
        """Return the lower bound, upper bound and usual size of each effect parameter, (3, slots)."""
        known = [
            # A parameter that is usually zero, such as an angle, gets a tenth of its range as its usual size.
            (one.lower, one.upper, abs(one.typical - one.null) or 0.1 * (one.upper - one.lower))
            for one in (slot.facts for slot in self.slots)
        ]
        return np.array(known).reshape(-1, 3).T

    def free(self) -> np.ndarray:
        """Return a mask (p,) that is True for parameters not on a bound."""
        lowest, highest = self.room()
        return (lowest < -_AT_BOUND) & (highest > _AT_BOUND)

    def at_bounds(self) -> dict[str, float]:
        """Return the fitted values of base and effects that lie on a bound, with that bound."""
        base = self.fitted_base
        found = dict(base.at_bounds) if isinstance(base, Simulator) and self.own else {}
        return found | {f"{slot.effect}: {slot.parameter}": bound for slot, bound in self._on_bounds()}

    def at_limits(self, name: str, kind: Kind) -> str:
        """Return the names of an effect's amplitudes that lie on a limit of their range in some group,
        separated by commas; for the kind ``shape``, those of its lengths, such as ranges and depths. The null
        of an amplitude does not count as a limit.
        """
        own = ((one.parameter, one.facts, bound) for one, bound in self._on_bounds() if one.effect == name)
        counted = (
            parameter
            for parameter, facts, bound in own
            if facts.kind == kind
            and (bound != facts.null if kind == "amplitude" else facts.unit in ("µm", "px"))
        )
        return ", ".join(dict.fromkeys(counted))

    def _on_bounds(self) -> list[tuple[Slot, float]]:
        return [
            (slot, bound)
            for slot, value in zip(self.slots, self.vector[self.own :].tolist(), strict=True)
            for bound in (slot.facts.lower, slot.facts.upper)
            if abs(value - bound) < _AT_BOUND * max(1.0, abs(bound))
        ]


def is_refitted(base: nn.Module) -> bool:
    """Return whether the base has few enough parameters to be fitted together with the effects."""
    trainable = any(p.requires_grad for p in base.parameters())
    return trainable and is_small(base) and not isinstance(base, FoldedBase)


def _parameters(base: nn.Module) -> Sequence[nn.Parameter]:
    return [p for p in base.parameters() if p.requires_grad] if is_refitted(base) else []


def _numbers(base: nn.Module) -> np.ndarray:
    own = [p.detach().numpy().reshape(-1) for p in _parameters(base)]
    return np.concatenate(own or [np.empty(0)]).astype(np.float64)
