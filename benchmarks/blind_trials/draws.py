"""What is planted: drawn from one seed over all knobs of the virtual fab, before anything is run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.blind_trials.records import Draw, Kind, KnobDraw
from litho_data.foundation.errors import InputError
from litho_data.virtual_fab.knobs import KNOBS, OFF_CATALOGUE

SMALLEST_RMS_NM, LARGEST_RMS_NM = 4.0, 60.0
FEWEST_TRIALS = 4
# Shares of the trials; what rounding leaves over goes to single effects.
_SHARES: dict[Kind, float] = {"two": 0.15, "none": 0.1, "off-catalogue": 0.15}


def draw_trials(count: int, seed: int) -> list[Draw]:
    """The trials of a campaign, in random order of their kinds.

    Knobs are dealt like cards: none comes twice before all have come once. Two effects at once come
    from the catalogue and differ in their identifier. Sizes are log-uniform.

    Raises:
        InputError: too few trials for one of each kind, or a negative seed.
    """
    if count < FEWEST_TRIALS:
        raise InputError("count", got=count, wanted=f"at least {FEWEST_TRIALS}, one of each kind")
    if seed < 0:
        raise InputError("seed", got=seed, wanted="0 or more")
    rng = np.random.default_rng(seed)
    some: list[Kind] = [kind for kind, share in _SHARES.items() for _ in range(max(1, round(share * count)))]
    singles: list[Kind] = ["single"] * (count - len(some))
    kinds = [*some, *singles]
    catalogue = _deal([name for name, knob in KNOBS.items() if knob.effect != OFF_CATALOGUE], rng)
    outside = _deal([name for name, knob in KNOBS.items() if knob.effect == OFF_CATALOGUE], rng)
    trials = []
    for number, place in enumerate(rng.permutation(count)):
        kind = kinds[place]
        names: list[str] = []
        if kind == "off-catalogue":
            names = [next(outside)]
        elif kind == "single":
            names = [next(catalogue)]
        elif kind == "two":
            names = _pair(catalogue)
        knobs = [KnobDraw(name=name, wanted_rms_nm=_size_nm(rng)) for name in names]
        trials.append(Draw(number=number, kind=kind, seed=int(rng.integers(2**31)), knobs=knobs))
    return trials


def _deal(names: list[str], rng: np.random.Generator) -> Iterator[str]:
    own = np.random.default_rng(rng.integers(2**63))
    while True:
        yield from (names[i] for i in own.permutation(len(names)))


def _pair(deck: Iterator[str]) -> list[str]:
    first = next(deck)
    return [first, next(name for name in deck if KNOBS[name].effect != KNOBS[first].effect)]


def _size_nm(rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(np.log(SMALLEST_RMS_NM), np.log(LARGEST_RMS_NM))))
