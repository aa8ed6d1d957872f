"""The twin: a base model with effects, each with one strength for all scans or one for each group of them."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from litho_models.effects import Parameter, get_effect
from litho_models.effects.chain import EffectChain
from litho_models.effects.registry import in_forward_order
from litho_models.fitting.small_models import parameter_room
from litho_models.loop.folded_base import FoldedBase
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms.grouped import ALL, label_of
from litho_models.simulator import Simulator, is_small

Values = dict[str, dict[str, float]]
# Of the usual size of a number: a step of its difference quotient, and how near a bound is on it.
_BASE_STEP, _EFFECT_STEP, _AT_BOUND = 5e-3, 0.05, 1e-6


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
        full_height_um, pitch_um: of the layouts.
        scan_frame, print_frame: effects that turn with the scan, or keep to the print, whatever the catalogue
            says; see ``EffectChain``.
    """

    base: nn.Module
    by: Mapping[str, str]
    choices: Mapping[str, Mapping[str, float]]
    slots: tuple[Slot, ...]
    vector: np.ndarray
    full_height_um: float
    pitch_um: float
    scan_frame: frozenset[str] = frozenset()
    print_frame: frozenset[str] = frozenset()

    @classmethod
    def bare(cls, base: nn.Module, scan: PreparedScan) -> Twin:
        """The base alone, for scans like this one."""
        return cls.of_base(base, scan.context.full_height_um, scan.context.pitch_um)

    @classmethod
    def of_base(cls, base: nn.Module, full_height_um: float, pitch_um: float) -> Twin:
        """The base alone, for layouts of this height and pitch."""
        own = [p.detach().numpy().reshape(-1) for p in _parameters(base)]
        vector = np.concatenate(own or [np.empty(0)]).astype(np.float64)
        return cls(base, {}, {}, (), vector, full_height_um, pitch_um)

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

    def with_effect(self, name: str, by: str, values: Mapping[str, Mapping[str, float]]) -> Twin:
        """One effect more, with starting values by label (``""`` for all scans)."""
        effect = get_effect(name)
        first = next(iter(values.values()))
        slots, numbers = [], []
        for parameter, facts in effect.parameters.items():
            if facts.kind == "choice":
                continue
            labels = sorted(values) if facts.kind == "amplitude" and by != ALL else [None]
            for label in labels:
                slots.append(Slot(name, parameter, label))
                numbers.append(first[parameter] if label is None else values[label][parameter])
        chosen = {key: first[key] for key, facts in effect.parameters.items() if facts.kind == "choice"}
        order = in_forward_order([*self.by, name])
        return replace(
            self,
            by={one: {**self.by, name: by}[one] for one in order},
            choices={**self.choices, name: chosen},
            slots=(*self.slots, *slots),
            vector=np.concatenate([self.vector, numbers]),
        )

    def without(self, name: str) -> Twin:
        """The same without one of its effects."""
        kept = [i for i, slot in enumerate(self.slots) if slot.effect != name]
        return replace(
            self,
            by={one: by for one, by in self.by.items() if one != name},
            choices={one: own for one, own in self.choices.items() if one != name},
            slots=tuple(self.slots[i] for i in kept),
            vector=np.concatenate([self.vector[: self.own], self.vector[self.own :][kept]]),
        )

    def alone(self) -> Twin:
        """The same without any effect."""
        return replace(self, by={}, choices={}, slots=(), vector=self.vector[: self.own])

    def ungrouped(self) -> Twin:
        """The same with one strength for all scans, the groups' mean; numbers in the order of action."""
        twin = self.alone()
        for name, values in self.values({}).items():
            twin = twin.with_effect(name, ALL, {"": values})
        return twin

    def over(self, base: nn.Module, scan: PreparedScan) -> Twin:
        """The same effects over another base."""
        bare = Twin.bare(base, scan)
        vector = np.concatenate([bare.vector, self.vector[self.own :]])
        return replace(self, base=base, vector=vector)

    def with_base_unfitted(self) -> np.ndarray:
        """The numbers with the base's as they are before any fit."""
        if not (self.own and isinstance(self.base, Simulator)):
            return self.vector
        fresh = type(self.base)(self.base.config)
        own = np.concatenate([p.detach().numpy().reshape(-1) for p in _parameters(fresh)])
        return np.concatenate([own.astype(np.float64), self.vector[self.own :]])

    def values(self, label_in: Mapping[str, str]) -> Values:
        """Parameter values of all effects for the scans with these labels, by grouping.

        An amplitude of a label that was never fitted is the mean of those that were.
        """
        found: Values = {name: dict(self.choices[name]) for name in self.by}
        alike: dict[tuple[str, str], dict[str | None, float]] = {}
        for slot, number in zip(self.slots, self.vector[self.own :], strict=True):
            alike.setdefault((slot.effect, slot.parameter), {})[slot.label] = float(number)
        for (name, parameter), known in alike.items():
            label = None if None in known else label_in.get(self.by[name], "")
            found[name][parameter] = known.get(label, float(np.mean(list(known.values()))))
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

    def placed(self) -> Placed:
        """The model at its numbers, ready to predict; the twin keeps a base of its own."""
        return Placed(self)

    def steps(self) -> np.ndarray:
        """Steps (p,) of difference quotients, upwards unless an effect has no room there."""
        steps = _BASE_STEP * np.maximum(np.abs(self.vector), 0.2)
        for at, slot in enumerate(self.slots, self.own):
            facts = slot.facts
            usual = facts.typical - (facts.null if facts.kind == "amplitude" else 0.0)
            size = _EFFECT_STEP * abs(usual)
            steps[at] = size if self.vector[at] + size <= facts.upper else -size
        return steps

    def room(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest step (p,) allowed from here: base and effects within their ranges."""
        lowest, highest = np.zeros(len(self.vector)), np.zeros(len(self.vector))
        if self.own:
            lowest[: self.own], highest[: self.own] = parameter_room(self.base, self.vector[: self.own])
        for at, slot in enumerate(self.slots, self.own):
            facts = slot.facts
            lowest[at], highest[at] = facts.lower - self.vector[at], facts.upper - self.vector[at]
        return np.minimum(lowest, 0), np.maximum(highest, 0)

    def free(self) -> np.ndarray:
        """True for numbers (p,) with room on both sides."""
        lowest, highest = self.room()
        return (lowest < -_AT_BOUND) & (highest > _AT_BOUND)

    def at_bounds(self) -> dict[str, float]:
        """Fitted values of base and effects that stand on a bound of their range, and that bound."""
        placed = self.placed().base
        found = dict(placed.at_bounds) if isinstance(placed, Simulator) and self.own else {}
        for slot, bound in self._on_bounds():
            found[f"{slot.effect}: {slot.parameter}"] = bound
        return found

    def exhausts(self, name: str) -> list[str]:
        """Amplitudes of an effect that some group has at a limit of their range other than the null."""
        found = [
            slot.parameter
            for slot, bound in self._on_bounds()
            if slot.effect == name and slot.facts.kind == "amplitude" and bound != slot.facts.null
        ]
        return [*dict.fromkeys(found)]

    def _on_bounds(self) -> list[tuple[Slot, float]]:
        return [
            (slot, bound)
            for slot, value in zip(self.slots, self.vector[self.own :].tolist(), strict=True)
            for bound in (slot.facts.lower, slot.facts.upper)
            if abs(value - bound) < _AT_BOUND * max(1.0, abs(bound))
        ]


class Placed:
    """A twin at its numbers; the base is a copy of its own."""

    def __init__(self, twin: Twin):
        self.twin = twin
        self.base = copy.deepcopy(twin.base) if twin.own else twin.base
        at = 0
        for parameter in _parameters(self.base):
            values = twin.vector[at : at + parameter.numel()]
            parameter.data.copy_(torch.as_tensor(values, dtype=parameter.dtype).reshape(parameter.shape))
            at += parameter.numel()
        self._chains: dict[tuple[str, ...], EffectChain] = {}

    def chain(self, scan: PreparedScan, extra: Values | None = None) -> EffectChain:
        """The chain of effects as it is for one scan; ``extra`` effects are tried on top."""
        return self.of_labels(self.twin.labels(scan), extra)

    def of_labels(self, labels: Mapping[str, str], extra: Values | None = None) -> EffectChain:
        """The chain for scans with these labels, by grouping; without any it has the mean strengths."""
        key = tuple(labels.values())
        if extra is not None or key not in self._chains:
            chain = EffectChain(
                self.base,
                {**self.twin.values(labels), **(extra or {})},
                full_height_um=self.twin.full_height_um,
                pitch_um=self.twin.pitch_um,
                scan_frame=self.twin.scan_frame,
                print_frame=self.twin.print_frame,
            )
            if extra is not None:
                return chain
            self._chains[key] = chain
        return self._chains[key]

    def base_height(self, chain: EffectChain, scan: PreparedScan, fold: int | None = None) -> Tensor:
        """Height (1, 1, y, x), µm, of the base on the layout with the effects that act on it."""
        return self.height_of(exposed(chain, scan), scan, fold)

    def height_of(self, exposed_um: Tensor, scan: PreparedScan, fold: int | None = None) -> Tensor:
        """Height (1, 1, y, x), µm, of the base alone on what is exposed (1, 1, y, x), µm."""
        base = self.base
        if isinstance(base, FoldedBase):
            base = base.of_scan(scan.id) if fold is None else base.of_fold(fold)
        with torch.no_grad():
            return base(exposed_um)

    def height(self, scan: PreparedScan, fold: int | None = None) -> np.ndarray:
        """Predicted height of the print (y, x), µm."""
        chain = self.chain(scan)
        return finished(chain, self.base_height(chain, scan, fold), scan)


def exposed(chain: EffectChain, scan: PreparedScan) -> Tensor:
    """The layout (1, 1, y, x), µm, with the effects that act on it."""
    with torch.no_grad():
        return chain.before_base(scan.layout, scan.context)


def finished(chain: EffectChain, base_height: Tensor, scan: PreparedScan) -> np.ndarray:
    """The height (y, x), µm, with the effects that act on it."""
    with torch.no_grad():
        return chain.after_base(base_height, scan.context)[0, 0].numpy()


def is_refitted(base: nn.Module) -> bool:
    """Whether the base has parameters, and few enough to be fitted together with the effects."""
    trainable = any(p.requires_grad for p in base.parameters())
    return trainable and is_small(base) and not isinstance(base, FoldedBase)


def _parameters(base: nn.Module) -> Sequence[nn.Parameter]:
    return [p for p in base.parameters() if p.requires_grad] if is_refitted(base) else []
