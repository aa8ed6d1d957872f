"""Choose the parameter sets to try for each candidate, and compute the changes that they make in the
scans.
"""

from __future__ import annotations

from collections import ChainMap, Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from litho_models.effects import Effect
from litho_models.effects.chain import Fields
from litho_models.loop.fits import ALL_FREE
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan


@dataclass(frozen=True)
class Trial:
    """Parameter sets of one effect with the same shape and size; their amplitudes are fitted together.

    ``columns`` are the indices of the trial's changes among the changes of all trials.
    """

    effect: Effect
    sets: tuple[Mapping[str, float], ...]
    columns: list[int] = field(default_factory=list)

    @cached_property
    def _facts(self) -> np.ndarray:
        """Return the null value, the lowest value and the highest value of each amplitude, and the usual
        distance of the amplitude from the null value.
        """
        facts = [self.effect.parameters[name] for name in self.effect.amplitudes]
        return np.array([(f.null, f.lower, f.upper, abs(f.typical - f.null) or 1.0) for f in facts]).T

    def steps(self, multiples: np.ndarray) -> np.ndarray:
        """Return the distance of each amplitude from its null value, (…, amplitudes), after the parameter
        sets are scaled by ``multiples`` (…, sets).
        """
        return multiples @ _steps(self.effect, self.sets)

    def allowed(self, multiples: np.ndarray) -> bool:
        """Return whether every amplitude lies on the allowed side of its null value after the parameter sets
        are scaled by ``multiples`` (…, sets).

        An amplitude with the wrong sign counts as noise and is ignored if it is small relative to the largest
        amplitude of any group.
        """
        (null, lower, upper, usual), steps = self._facts, self.steps(multiples)
        wrong = ((steps < 0) & (null <= lower)) | ((steps > 0) & (null >= upper))
        sizes = np.abs(steps) / usual
        return not (sizes[wrong] > 0.3 * sizes.max()).any()

    def reach(self, multiples: np.ndarray) -> float:
        """Return the largest share of the step that keeps all amplitudes within their ranges.

        A full step may leave the ranges, because it is a linear extrapolation.
        """
        (null, lower, upper, _), steps = self._facts, self.steps(multiples)
        room = np.where(steps > 0, upper, lower) - null
        beyond = (np.abs(room) < np.abs(steps)) & (room != 0)
        return float(np.min(room[beyond] / steps[beyond], initial=1.0))

    def start(self, multiples: np.ndarray) -> dict[str, float]:
        """Return the starting values of a fit. No value is farther from the null value than in the largest
        trial.
        """
        null, lower, upper, _ = self._facts
        largest = np.abs(_steps(self.effect, self.effect.trials)).max(axis=0)
        steps = np.clip(self.steps(multiples * self.reach(multiples)), -largest, largest)
        values = np.clip(null + steps, lower, upper).tolist()
        amplitudes = dict(zip(self.effect.amplitudes, values, strict=True))
        return {**self.effect.off_values(), **self.sets[0], **amplitudes}


def _steps(effect: Effect, sets: Sequence[Mapping[str, float]]) -> np.ndarray:
    """Return the distance of each amplitude from its null value in each parameter set, (sets, amplitudes)."""
    nulls = {name: effect.parameters[name].null for name in effect.amplitudes}
    return np.array([[one.get(name, null) - null for name, null in nulls.items()] for one in sets])


def trials_of(effects: Sequence[Effect], first: int = 0) -> list[Trial]:
    """Group the parameter sets of the effects into trials by shape and size.

    Columns are numbered from ``first``.

    The same amplitudes may be tried with the same shape at two sizes, because the change that a large effect
    makes need not be a multiple of the change that a small effect makes.
    """
    found: list[Trial] = []
    for effect in effects:
        sizes: Counter[object] = Counter()
        together: dict[object, list[Mapping[str, float]]] = {}
        for trial in effect.trials:
            shape = tuple(sorted((k, v) for k, v in trial.items() if k not in effect.amplitudes))
            alike = shape, frozenset(trial)
            together.setdefault((shape, sizes[alike]), []).append(trial)
            sizes[alike] += 1
        for own in together.values():
            found.append(Trial(effect, tuple(own), list(range(first, first + len(own)))))
            first += len(own)
    return found


class Secants:
    """Compute and cache how trials change the windows at a given model.

    Attributes:
        free_terms: orthonormal basis (n, k) of the free terms of each window.
    """

    def __init__(self, twin: Twin, windows: Sequence[PreparedScan]):
        self._twin, self._windows = twin, windows
        self._fields: list[Fields] = [{} for _ in windows]
        self._heights_um = [
            twin.height(one, known=known) for one, known in zip(windows, self._fields, strict=True)
        ]
        heights = zip(windows, self._heights_um, strict=True)
        self.free_terms = [one.free_basis(height, ALL_FREE) for one, height in heights]
        self._known: dict[tuple[object, ...], list[NDArray[np.float32]]] = {}

    def of(self, trials: Sequence[Trial]) -> list[list[NDArray[np.float32]]]:
        """Return the changes (n,), µm, that each set of each trial makes in each window."""
        rows = []
        for effect, values in ((trial.effect, own) for trial in trials for own in trial.sets):
            key = effect.name, *values.items()
            if key not in self._known:
                self._known[key] = self._changes(effect, values)
            rows.append(self._known[key])
        return [[row[at] for row in rows] for at in range(len(self._windows))]

    def _changes(self, effect: Effect, values: Mapping[str, float]) -> list[NDArray[np.float32]]:
        extra, found = {effect.name: effect.with_values(values)}, []
        for window, known, here in zip(self._windows, self._fields, self._heights_um, strict=True):
            moved = self._twin.height(window, extra, ChainMap({}, known))
            found.append(window.at_sample(moved - here).astype(np.float32))
        return found
