"""Choose at random which causes of error the virtual fab adds to the prints and scans of each trial of a
board. The causes are most knobs (settings of the virtual fab) and the forms in ``other_forms`` (laws that the
loop's catalogue does not contain).

One seed determines all draws. They are made before the loop runs on any trial.

There are two boards: ``singles`` with one cause per trial, and ``mixtures`` with two to four. Some trials of
either board have no cause. This module does not read the catalogue of effects that the loop searches.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, islice

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.virtual_fab.knobs import KNOBS, OFF_CATALOGUE
from litho_models.boards.other_forms import FORMS, Rng
from litho_models.boards.records import Board, CauseDraw, Draw, Kind

SINGLES: dict[Kind, int] = {"in-form": 21, "alias": 2, "other-form": 17, "empty": 8}
# Smallest and largest size (rms, nm) that is drawn for a cause. The strength for the drawn size is found on
# four scans. Measured on all scans, the size may be 13 % smaller. On the board ``singles``, even a cause of
# the smallest size then still exceeds ``COUNTS_FROM_RMS_NM``.
SINGLES_RMS_NM = (10.0, 25.0)
MIXTURES: dict[Kind, int] = {"mixture": 30, "measured": 4, "empty": 8}
MIXTURES_RMS_NM = (8.0, 25.0)
# Numbers of trials on the board ``mixtures`` that contain the following. LINEAR: a linear slope loss whose
# strength differs by batch. S_SHAPED: an S-shaped scanner axis in half of the scans. GROUPED: another cause
# whose strength differs by batch or field. BEYOND_PHYSICS: a printer that the Physics model cannot imitate.
LINEAR, S_SHAPED, GROUPED, BEYOND_PHYSICS = 4, 4, 8, 9
BASE_RMS_NM = (5.0, 15.0)

# These knobs (settings of the virtual fab that plant a cause) are not drawn. Line roughness is already part
# of the default noise. Long-range proximity leaves a residual of less than 10 nm after the base model is
# refitted.
_NOT_DEALT = {"line-roughness", "long-range-proximity"}
# A single model of all scans cannot represent these causes: they differ randomly from scan to scan or, like
# quantisation, only round the heights.
_OF_SINGLE_SCANS = {
    "quantisation",
    "registration-residual",
    "scan-line-stripes",
    "scars-and-spikes",
    "slow-drift",
    "periodic-lines",
}
# Causes that are not added to measured prints.
_NOT_IN_MEASURED = {
    # It also scales the print, and the registration of the measured scans has removed their scale.
    "lateral-shrinkage",
    # The prints may already have these causes, so finding them would prove nothing.
    "slope-thinning",
    "elliptical-psf",
    "galvo-lag",
    "piezo-nonlinearity",
    "tip-dilation",
}
# These knobs were added after the first boards were published. They are not drawn, so that each seed still
# gives the same board as before.
_LATER = ("stitching", "galvo-nonlinearity", "asymmetric-tip")
# Ranges from which the parameters of the printers are drawn. They lie around the defaults of the virtual fab
# and within the bounds of the Physics model.
_PRINTER_RANGES = {
    "threshold_dose": (0.2, 0.4),
    "threshold_steepness": (1.2, 3.0),
    "network_reach_um": (1.2, 2.2),
    "loose_retention": (0.3, 0.6),
    "base_um": (0.08, 0.2),
}


def draw_board(board: Board, seed: int) -> list[Draw]:
    """Choose at random the causes of each trial of a board. The trials are in random order, and each has its
    own printer parameters.

    Knobs and forms are in separate lists, from which they are drawn at random without replacement. When all
    of a list have been drawn, the list starts again. On the board ``singles``, a trial with a knob is of kind
    ``alias`` if the base model can imitate the effect of the knob or the per-scan terms can absorb it, and
    otherwise of kind ``in-form``. The sizes of the causes are drawn log-uniformly.

    Raises:
        InputError: the seed is negative.
    """
    if seed < 0:
        raise InputError("seed", got=seed, wanted="0 or more")
    return (_draw_singles if board == "singles" else _draw_mixtures)(np.random.default_rng(seed))


def names_of(cause: str) -> tuple[str, ...]:
    """Return the right answers for a knob or a form, as names of effects in the loop's catalogue."""
    if cause in FORMS:
        return FORMS[cause].names
    effect = KNOBS[cause].effect
    return () if effect == OFF_CATALOGUE else (effect,)


def _in_form() -> list[str]:
    return [
        one.name
        for one in KNOBS.values()
        if one.effect != OFF_CATALOGUE
        and not (one.nuisance_span or one.refit_absorbs)
        and one.name not in {*_NOT_DEALT, *_LATER}
    ]


def _other_forms() -> list[str]:
    return [form.name for form in FORMS.values() if form.deck == "both"]


def _draw_singles(rng: Rng) -> list[Draw]:
    aliases = [one.name for one in KNOBS.values() if one.nuisance_span or one.refit_absorbs]
    decks: dict[Kind, Iterator[str]] = {
        "in-form": _deal(_in_form(), rng),
        "alias": _deal(aliases, rng),
        "other-form": _deal(_other_forms(), rng),
        "empty": iter(()),
    }
    kinds = [kind for kind, count in SINGLES.items() for _ in range(count)]
    trials = []
    for number, place in enumerate(rng.permutation(len(kinds))):
        kind = kinds[place]
        printer = _draw_printer(rng)
        causes = [
            CauseDraw(name=name, wanted_rms_nm=_size_nm(rng, SINGLES_RMS_NM))
            for name in islice(decks[kind], 1)
        ]
        trials.append(Draw(number=number, kind=kind, seed=_seed(rng), causes=causes, printer=printer))
    return trials


def _draw_mixtures(rng: Rng) -> list[Draw]:
    """Draw the trials of the board ``mixtures``.

    About half of the causes have a form that is in the loop's catalogue. No two causes of a trial have a
    right answer in common.
    """
    in_form = _deal([name for name in _in_form() if name not in _OF_SINGLE_SCANS], rng)
    other = _deal([name for name in _other_forms() if name not in _OF_SINGLE_SCANS], rng)
    deck = chain.from_iterable(zip(in_form, other, strict=False))
    first = ["linear-slope-loss"] * LINEAR + ["s-shaped-axis"] * S_SHAPED
    kinds: list[Kind] = [kind for kind, count in MIXTURES.items() for _ in range(count)]
    sizes = rng.permutation([2 + at % 3 for at in range(len(kinds))])
    bases = [form.name for form in FORMS.values() if form.deck == "base"]
    beyond = rng.permutation(MIXTURES["mixture"])[:BEYOND_PHYSICS].tolist()
    drawn = []
    for at, kind in enumerate(kinds):
        base, causes = None, []
        if at in beyond:
            name = bases[beyond.index(at) % len(bases)]
            base = CauseDraw(name=name, wanted_rms_nm=_size_nm(rng, BASE_RMS_NM))
        if kind != "empty":
            refused = {
                *(names_of(base.name) if base else ()),
                *(_NOT_IN_MEASURED if kind == "measured" else ()),
            }
            names = _without_overlap(first[at : at + 1], int(sizes[at]), deck, refused)
            causes = [CauseDraw(name=name, wanted_rms_nm=_size_nm(rng, MIXTURES_RMS_NM)) for name in names]
            causes[0] = _in_groups(causes[0], at, rng)
        printer = _draw_printer(rng)
        if base and base.name == "hill-response":
            # This form replaces the logistic response, so the parameters of that response are not drawn.
            printer = {name: value for name, value in printer.items() if not name.startswith("threshold")}
        drawn.append(Draw(number=0, kind=kind, seed=0, causes=causes, printer=printer, base=base))
    return [
        drawn[at].model_copy(update={"number": number, "seed": _seed(rng)})
        for number, at in enumerate(rng.permutation(len(drawn)))
    ]


def _in_groups(cause: CauseDraw, at: int, rng: Rng) -> CauseDraw:
    """In the first trials of the board ``mixtures``, make the strength of a cause differ by batch or by
    field. In all other trials, return the cause unchanged. ``at`` is the index of the trial before the trials
    are shuffled.
    """
    if at < LINEAR:
        return _by_batch(cause, rng)
    if at < LINEAR + S_SHAPED:
        return _by_field(cause, rng, weak=0.0)
    if at < LINEAR + S_SHAPED + GROUPED:
        return (_by_batch if at % 2 else _by_field)(cause, rng)
    return cause


def _seed(rng: Rng) -> int:
    return int(rng.integers(2**31))


def _draw_printer(rng: Rng) -> dict[str, float]:
    return {name: round(rng.uniform(*limits), 3) for name, limits in _PRINTER_RANGES.items()}


def _by_batch(cause: CauseDraw, rng: Rng) -> CauseDraw:
    """Draw a point near the middle of the printing order, and make a cause weaker in the prints after it."""
    place, weak = f"{rng.uniform(-0.2, 0.2):.3f}", round(rng.uniform(0.0, 0.6), 3)
    return cause.model_copy(update={"by": "batch", "place": place, "weak": weak})


def _by_field(cause: CauseDraw, rng: Rng, weak: float | None = None) -> CauseDraw:
    """Make a cause weaker in two of the four fields of each print."""
    place = "".join(sorted(rng.permutation(list("1234"))[:2]))
    weak = round(rng.uniform(0.0, 0.6), 3) if weak is None else weak
    return cause.model_copy(update={"by": "field", "place": place, "weak": weak})


def _deal(names: Sequence[str], rng: Rng) -> Iterator[str]:
    own = np.random.default_rng(rng.integers(2**63))
    while True:
        yield from (names[i] for i in own.permutation(len(names)))


def _without_overlap(started: Sequence[str], size: int, deck: Iterator[str], refused: set[str]) -> list[str]:
    """Start with the causes ``started``, and add causes from ``deck`` until there are ``size`` causes. Skip a
    cause if one of its right answers is in ``refused`` or is also a right answer for an earlier cause.
    """
    names = list(started)
    while len(names) < size:
        name = next(deck)
        taken = {right for one in names for right in names_of(one)} | refused
        if name not in names and not taken & {*names_of(name)}:
            names.append(name)
    return names


def _size_nm(rng: Rng, limits: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(limits))))
