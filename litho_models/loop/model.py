"""The twin: a base model with effects, each with one strength for all scans or one for each group of them."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from litho_models.effects import Parameter, get_effect
from litho_models.effects.chain import EffectChain, Frame
from litho_models.effects.registry import in_forward_order
from litho_models.fitting.small_models import parameter_room
from litho_models.loop.folded_base import FoldedBase
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms.grouped import ALL, label_of
from litho_models.simulator import Simulator, is_small

Values = dict[str, dict[str, float]]
# How near a fitted number is to a bound that it stands on, of its size.
_AT_BOUND = 1e-6


@dataclass(frozen=True)
class Slot:
    """One fitted number of an effect; ``label``: the group that has it, None for all scans."""

    effect: str
    parameter: str
    label: str | None

    @property
    def facts(self) -> Parameter:
        """What the catalogue says of the number."""
        return get_effect(self.effect).parameters[self.parameter]


@dataclass(frozen=True)
class Twin:
    """Base and effects with their numbers; a fit moves ``vector`` and leaves the rest.

    Attributes:
        base: the model of the printer; its own numbers are refitted if they are few.
        by: effect to the grouping in which its strength differs, ``all`` for one strength.
        choices: effect to the values of parameters that are never fitted (a direction).
        slots: the fitted numbers of the effects, in the order of ``vector``, after those of the base.
        vector: all fitted numbers.
        frames: what an effect turns with, where it is not what the catalogue says; see ``EffectChain``.
    """

    base: nn.Module
    by: Mapping[str, str]
    choices: Mapping[str, Mapping[str, float]]
    slots: tuple[Slot, ...]
    vector: np.ndarray
    frames: Mapping[str, Frame] = field(default_factory=dict)
    _chains: dict[tuple[str, ...], EffectChain] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @classmethod
    def bare(cls, base: nn.Module) -> Twin:
        """The base alone."""
        return cls(base, {}, {}, (), _numbers(base))

    @property
    def own(self) -> int:
        """How many of the numbers are the base's."""
        return len(self.vector) - len(self.slots)

    @property
    def names(self) -> tuple[str, ...]:
        """The effects, as they act."""
        return tuple(self.by)

    def at(self, vector: np.ndarray) -> Twin:
        """The same with other numbers."""
        return replace(self, vector=vector)

    def of_fold(self, fold: int) -> Twin:
        """The same over a base that has not seen the fold, where one was trained without each."""
        base = self.base
        return replace(self, base=base.of_fold(fold)) if isinstance(base, FoldedBase) else self

    def with_effect(self, name: str, by: str, values: Mapping[str, Mapping[str, float]]) -> Twin:
        """One effect more, with starting values by label (``""`` for all scans)."""
        effect = get_effect(name)
        first = next(iter(values.values()))
        fitted = {key: facts for key, facts in effect.parameters.items() if facts.kind != "choice"}
        slots = [
            Slot(name, key, label)
            for key, facts in fitted.items()
            for label in (sorted(values) if facts.kind == "amplitude" and by != ALL else [None])
        ]
        numbers = [values.get(slot.label or "", first)[slot.parameter] for slot in slots]
        groupings = {**self.by, name: by}
        return replace(
            self,
            by={one: groupings[one] for one in in_forward_order(list(groupings))},
            choices={
                **self.choices,
                name: {key: first[key] for key in effect.parameters if key not in fitted},
            },
            slots=(*self.slots, *slots),
            vector=np.concatenate([self.vector, numbers]),
        )

    def only(self, names: Collection[str]) -> Twin:
        """The same with no other effects than these."""
        kept = [i for i, slot in enumerate(self.slots) if slot.effect in names]
        return replace(
            self,
            by={one: by for one, by in self.by.items() if one in names},
            choices={one: own for one, own in self.choices.items() if one in names},
            slots=tuple(self.slots[i] for i in kept),
            vector=np.concatenate([self.vector[: self.own], self.vector[self.own :][kept]]),
        )

    def without(self, name: str) -> Twin:
        """The same without one of its effects."""
        return self.only({*self.by} - {name})

    def alone(self) -> Twin:
        """The same without any effect."""
        return self.only(())

    def ungrouped(self) -> Twin:
        """The same with one strength for all scans, the groups' mean; numbers in the order of action."""
        twin = self.alone()
        for name, values in self.values({}).items():
            twin = twin.with_effect(name, ALL, {"": values})
        return twin

    def over(self, base: nn.Module) -> Twin:
        """The same effects over another base."""
        return replace(self, base=base, vector=np.concatenate([_numbers(base), self.vector[self.own :]]))

    def with_base_unfitted(self) -> np.ndarray:
        """The numbers with the base's as they are before any fit."""
        if not (self.own and isinstance(self.base, Simulator)):
            return self.vector
        return np.concatenate([_numbers(type(self.base)(self.base.config)), self.vector[self.own :]])

    def values(self, label_in: Mapping[str, str]) -> Values:
        """Parameter values of all effects for the scans with these labels, by grouping.

        An amplitude of a label that was never fitted is the mean of those that were.
        """
        found: Values = {name: dict(self.choices[name]) for name in self.by}
        alike: dict[tuple[str, str], dict[str | None, float]] = {}
        for slot, number in zip(self.slots, self.vector[self.own :], strict=True):
            alike.setdefault((slot.effect, slot.parameter), {})[slot.label] = float(number)
        for (name, parameter), known in alike.items():
            mean = float(np.mean(list(known.values())))
            found[name][parameter] = known.get(label_in.get(self.by[name], ""), mean)
        return found

    def labels(self, scan: PreparedScan) -> dict[str, str]:
        """The scan's label in every grouping in use."""
        return {by: label_of(scan.stored, by) for by in dict.fromkeys(self.by.values()) if by != ALL}

    def is_of(self, slot: Slot, scan: PreparedScan) -> bool:
        """Whether a number is one of the scan's own group, or of all scans."""
        return slot.label is None or slot.label == label_of(scan.stored, self.by[slot.effect])

    def known_from(self, scans: Sequence[PreparedScan]) -> Twin:
        """The same with nothing but these scans behind it.

        A strength of a group that none of them is in becomes the mean of the other groups' strengths.
        """
        seen = [any(self.is_of(slot, scan) for scan in scans) for slot in self.slots]
        vector = self.vector.copy()
        for at, slot in enumerate(self.slots):
            if not seen[at]:
                alike = [
                    self.vector[self.own + other]
                    for other, one in enumerate(self.slots)
                    if seen[other] and (one.effect, one.parameter) == (slot.effect, slot.parameter)
                ]
                vector[self.own + at] = np.mean(alike) if alike else slot.facts.null
        return self.at(vector)

    @cached_property
    def fitted_base(self) -> nn.Module:
        """The base at its numbers: a copy of its own, where it has any."""
        if not self.own:
            return self.base
        base, at = copy.deepcopy(self.base), 0
        for parameter in _parameters(base):
            values = self.vector[at : at + parameter.numel()]
            parameter.data.copy_(torch.as_tensor(values, dtype=parameter.dtype).reshape(parameter.shape))
            at += parameter.numel()
        return base

    def chain(self, scan: PreparedScan | None = None, extra: Values | None = None) -> EffectChain:
        """The chain of effects as it is for one scan, or with mean strengths; ``extra``: tried on top."""
        labels = {} if scan is None else self.labels(scan)
        key = tuple(labels.values())
        if extra or key not in self._chains:
            values = {**self.values(labels), **(extra or {})}
            chain = EffectChain(self.fitted_base, values, frames=self.frames)
            if extra:
                return chain
            self._chains[key] = chain
        return self._chains[key]

    @torch.no_grad()
    def exposed(self, scan: PreparedScan) -> Tensor:
        """The layout (1, 1, y, x), µm, with the effects that act on it."""
        return self.chain(scan).before_base(scan.context.layout_um, scan.context)

    @torch.no_grad()
    def base_height(self, exposed_um: Tensor, scan: PreparedScan) -> Tensor:
        """Height (1, 1, y, x), µm, of the base alone on what is exposed (1, 1, y, x), µm."""
        base = self.fitted_base
        return (base.of_scan(scan.id) if isinstance(base, FoldedBase) else base)(exposed_um)

    @torch.no_grad()
    def height(
        self, scan: PreparedScan, extra: Values | None = None, base_um: Tensor | None = None
    ) -> np.ndarray:
        """Predicted height of the print (y, x), µm; ``base_um``: that of the base, where it is known."""
        chain = self.chain(scan, extra)
        if base_um is None:
            base_um = self.base_height(chain.before_base(scan.context.layout_um, scan.context), scan)
        return chain.after_base(base_um, scan.context)[0, 0].numpy()

    def steps(self) -> np.ndarray:
        """Steps (p,) of difference quotients, upwards unless an effect has no room there."""
        _, upper, usual = self._ranges()
        own, size = self.vector[: self.own], 0.05 * usual
        effects = np.where(self.vector[self.own :] + size <= upper, size, -size)
        return np.concatenate([5e-3 * np.maximum(np.abs(own), 0.2), effects])

    def room(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest step (p,) allowed from here: base and effects within their ranges."""
        lower, upper, _ = self._ranges()
        own, effects = self.vector[: self.own], self.vector[self.own :]
        lowest, highest = parameter_room(self.base, own) if self.own else (own, own)
        return (
            np.minimum(np.concatenate([lowest, lower - effects]), 0),
            np.maximum(np.concatenate([highest, upper - effects]), 0),
        )

    def _ranges(self) -> np.ndarray:
        """Of each effect's number lower bound, upper bound and usual size, (3, slots)."""
        facts = [slot.facts for slot in self.slots]
        nulls = [one.null if one.kind == "amplitude" else 0.0 for one in facts]
        known = [
            # What is zero as a rule, as an angle, has a tenth of its range for a usual size.
            (one.lower, one.upper, abs(one.typical - null) or 0.1 * (one.upper - one.lower))
            for one, null in zip(facts, nulls, strict=True)
        ]
        return np.array(known).reshape(-1, 3).T

    def free(self) -> np.ndarray:
        """True for numbers (p,) with room on both sides."""
        lowest, highest = self.room()
        return (lowest < -_AT_BOUND) & (highest > _AT_BOUND)

    def at_bounds(self) -> dict[str, float]:
        """Fitted values of base and effects that stand on a bound of their range, and that bound."""
        base = self.fitted_base
        found = dict(base.at_bounds) if isinstance(base, Simulator) and self.own else {}
        return found | {f"{slot.effect}: {slot.parameter}": bound for slot, bound in self._on_bounds()}

    def exhausts(self, name: str) -> list[str]:
        """Amplitudes of an effect that some group has at a limit of their range other than the null."""
        own = [(slot, bound) for slot, bound in self._on_bounds() if slot.effect == name]
        beyond = (slot for slot, at in own if slot.facts.kind == "amplitude" and at != slot.facts.null)
        return [*dict.fromkeys(slot.parameter for slot in beyond)]

    def _on_bounds(self) -> list[tuple[Slot, float]]:
        return [
            (slot, bound)
            for slot, value in zip(self.slots, self.vector[self.own :].tolist(), strict=True)
            for bound in (slot.facts.lower, slot.facts.upper)
            if abs(value - bound) < _AT_BOUND * max(1.0, abs(bound))
        ]


def is_refitted(base: nn.Module) -> bool:
    """Whether the base has parameters, and few enough to be fitted together with the effects."""
    trainable = any(p.requires_grad for p in base.parameters())
    return trainable and is_small(base) and not isinstance(base, FoldedBase)


def _parameters(base: nn.Module) -> Sequence[nn.Parameter]:
    return [p for p in base.parameters() if p.requires_grad] if is_refitted(base) else []


def _numbers(base: nn.Module) -> np.ndarray:
    own = [p.detach().numpy().reshape(-1) for p in _parameters(base)]
    return np.concatenate(own or [np.empty(0)]).astype(np.float64)
