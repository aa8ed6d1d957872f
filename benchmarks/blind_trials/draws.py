"""What is planted: drawn from one seed over what the virtual fab can do, before anything is run.

Two plans: the board of 48 trials since seed 20267, and the one that boards up to seed 20266 were drawn by,
kept so that they can be made again. Nothing here reads the loop's catalogue of effects.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np

from benchmarks.blind_trials.other_forms import FORMS
from benchmarks.blind_trials.records import Draw, Kind, KnobDraw
from litho_data.foundation.errors import InputError
from litho_data.virtual_fab.knobs import KNOBS, OFF_CATALOGUE

# The board: at least 20 causes in form and 16 of another form are to count, so one more of each is drawn.
BOARD: dict[Kind, int] = {"in-form": 21, "alias": 2, "other-form": 17, "empty": 8}
# Sought on four scans, a size is up to 13 % off on all of them: what is drawn is to count nevertheless.
BOARD_RMS_NM = (10.0, 25.0)
# The default noise has the first, so it is seen in every trial; a refit leaves less than 10 nm of the second.
_NOT_DEALT = {"line-roughness", "long-range-proximity"}
# Base parameters within the Physics model and its bounds, other than the fab's own.
_PRINTER_RANGES = {
    "threshold_dose": (0.2, 0.4),
    "threshold_steepness": (1.2, 3.0),
    "network_reach_um": (1.2, 2.2),
    "loose_retention": (0.3, 0.6),
    "base_um": (0.08, 0.2),
}

# The plan of boards up to seed 20266: shares of the trials; what rounding leaves over goes to single effects.
EARLIER_RMS_NM = (4.0, 60.0)
FEWEST_TRIALS = 4
# Knobs that came after the boards that are published, which are drawn as they were.
_LATER = ("stitching", "galvo-nonlinearity", "asymmetric-tip")
_SHARES: dict[Kind, float] = {"two": 0.15, "none": 0.1, "off-catalogue": 0.15}


def draw_board(seed: int) -> list[Draw]:
    """The 48 trials of a board, in random order, each with a printer of its own.

    Knobs and forms are dealt like cards: none comes twice before all have come once. In form come knobs that
    the base cannot imitate; as aliases those that it can, or that the scans' own terms absorb. Sizes are
    log-uniform.

    Raises:
        InputError: a negative seed.
    """
    rng = _rng(seed)
    named = [one for one in KNOBS.values() if one.effect != OFF_CATALOGUE and one.name not in _LATER]
    aliases = [knob.name for knob in named if knob.nuisance_span or knob.refit_absorbs]
    in_form = [knob.name for knob in named if knob.name not in {*aliases, *_NOT_DEALT}]
    decks: dict[Kind, Iterator[str]] = {
        "in-form": _deal(in_form, rng),
        "alias": _deal(aliases, rng),
        "other-form": _deal([*FORMS], rng),
        "empty": iter(()),
    }
    kinds = [kind for kind, count in BOARD.items() for _ in range(count)]
    trials = []
    for number, place in enumerate(rng.permutation(len(kinds))):
        kind = kinds[place]
        printer = {name: round(rng.uniform(*limits), 3) for name, limits in _PRINTER_RANGES.items()}
        knobs = [
            KnobDraw(name=name, wanted_rms_nm=_size_nm(rng, BOARD_RMS_NM)) for name in islice(decks[kind], 1)
        ]
        trial_seed = int(rng.integers(2**31))
        trials.append(Draw(number=number, kind=kind, seed=trial_seed, knobs=knobs, printer=printer))
    return trials


def draw_earlier(count: int, seed: int) -> list[Draw]:
    """The trials of a campaign as boards up to seed 20266 were drawn, in random order of their kinds.

    Knobs are dealt like cards. Two effects at once come from the catalogue and differ in their identifier.
    Sizes are log-uniform.

    Raises:
        InputError: too few trials for one of each kind, or a negative seed.
    """
    if count < FEWEST_TRIALS:
        raise InputError("count", got=count, wanted=f"at least {FEWEST_TRIALS}, one of each kind")
    rng = _rng(seed)
    some: list[Kind] = [kind for kind, share in _SHARES.items() for _ in range(max(1, round(share * count)))]
    singles: list[Kind] = ["single"] * (count - len(some))
    kinds = [*some, *singles]
    known = {name: knob.effect != OFF_CATALOGUE for name, knob in KNOBS.items() if name not in _LATER}
    catalogue = _deal([name for name, inside in known.items() if inside], rng)
    outside = _deal([name for name, inside in known.items() if not inside], rng)
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
        knobs = [KnobDraw(name=name, wanted_rms_nm=_size_nm(rng, EARLIER_RMS_NM)) for name in names]
        trials.append(Draw(number=number, kind=kind, seed=int(rng.integers(2**31)), knobs=knobs))
    return trials


def _rng(seed: int) -> np.random.Generator:
    if seed < 0:
        raise InputError("seed", got=seed, wanted="0 or more")
    return np.random.default_rng(seed)


def _deal(names: Sequence[str], rng: np.random.Generator) -> Iterator[str]:
    own = np.random.default_rng(rng.integers(2**63))
    while True:
        yield from (names[i] for i in own.permutation(len(names)))


def _pair(deck: Iterator[str]) -> list[str]:
    first = next(deck)
    return [first, next(name for name in deck if KNOBS[name].effect != KNOBS[first].effect)]


def _size_nm(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(limits))))
