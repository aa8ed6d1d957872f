"""Choose the scans of each print and design the tiles of its layout; interrupted runs resume."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from litho_data.foundation.files import atomic_file
from litho_data.register.coarse import SEARCH_BLUR_PX
from litho_data.register.orientation import rival_alignment
from litho_data.register.topography import predicted_topography
from litho_models.planning.layouts import Limits, climb, score, starts
from litho_models.planning.rivalry import Place, Rivalry, Way

TURNED = Way(turned_deg=90)
WORDS = {
    TURNED: "rotated by 90°",
    Way(direction=-1): "in the other direction",
    Way(tip=2): "with a new, sharp tip",
    Way(pixel_size=0.5): "with half the pixel size and the same time per pixel",
}
_MOST_EXTRAS = 2
# A further scan is planned if it increases the separation of the rivals by at least this factor.
_WORTH = 1.3
# A lower dose keeps every exposure in the range that the models know, unlike a higher dose.
SECOND_DOSE = 0.8
# Below this separation, in standard deviations, a layout does not show the difference.
_NOTHING = 0.3
# Registration refuses layouts whose self-similarity exceeds 0.9. The limit here is lower, because prints are
# less clear than layouts.
_MOST_REPEATING = 0.7


class Chosen(NamedTuple):
    """How prints are made and scanned for one question or for all questions.

    ``ways`` lists how each print is scanned. Successive prints cycle through the ``places`` in the write
    field and through the ``doses``. ``tried`` contains separations in standard deviations: the separation
    with one plain scan, and the separations with other ways in addition to the plain scan.
    """

    ways: tuple[Way, ...]
    places: tuple[Place, ...]
    doses: tuple[float, ...]
    tried: dict[str, float]


def choose(rivalry: Rivalry, level: np.ndarray, can_move: bool) -> Chosen:
    """Choose the ways to print and scan that separate the rivals of a question.

    Args:
        level: layout on which the ways are tried.
        can_move: whether the write field is larger than a print.
    """
    ways: tuple[Way, ...] = (Way(),)
    reached = score(rivalry, level, ways)
    tried = {"one plain scan": reached}
    for _ in range(_MOST_EXTRAS):
        scores = {way: score(rivalry, level, (*ways, way)) for way in WORDS if way not in ways}
        # The report shows the separation with one plain scan and this way only, so earlier values are kept.
        tried = tried | {f"a scan {WORDS[way]}": own for way, own in scores.items()} | tried
        best = max(scores, key=lambda way: scores[way])
        if not _worth(scores[best], reached):
            break
        ways, reached = (*ways, best), scores[best]
    places: tuple[Place, ...] = ("centre",)
    if can_move:
        tried["at the edge of the write field"] = at_edge = score(rivalry, level, ways, "edge")
        places = ("edge", "centre") if _worth(at_edge, reached) else places
    one, two = (score(rivalry, level, ways, places[0], (1.0, dose)) for dose in (1.0, SECOND_DOSE))
    both = "two prints with these scans"
    tried |= {both: one, f"{both}, the second at {SECOND_DOSE:g} of the dose": two}
    return Chosen(ways, places, (1.0, SECOND_DOSE) if _worth(two, one) else (1.0,), tried)


def together(choices: Sequence[Chosen], asked: tuple[Way, ...]) -> Chosen:
    """Combine the choices for all questions. ``asked`` contains the ways to scan that are needed for
    questions without a layout.
    """
    ways = dict.fromkeys([Way(), *asked, *(way for one in choices for way in one.ways)])
    places = max((one.places for one in choices), key=len, default=("centre",))
    return Chosen(tuple(ways), places, max((one.doses for one in choices), key=len, default=(1.0,)), {})


def _worth(more: float, reached: float) -> bool:
    return more >= max(_WORTH * reached, _NOTHING)


def climbed(
    rivalries: Sequence[Rivalry],
    chosen: Chosen,
    limits: Limits,
    tile_px: int,
    count: int,
    *,
    seed: int,
    steps: int,
    kept: Path,
    report: Callable[[str], None],
) -> tuple[list[np.ndarray], list[str]]:
    """Optimise tiles for one question after the other. Return the soft levels of the tiles and the names of
    the layouts from which they started.

    Args:
        kept: folder of finished tiles; tiles of an interrupted run are reused.
    """
    kept.mkdir(parents=True, exist_ok=True)
    report(f"{sum(1 for _ in kept.glob('[0-9]*.npy'))} of {count} tiles are kept from an earlier run")
    able = [one for one in starts(tile_px, limits, seed) if _repeats(one[1]) <= _MOST_REPEATING]
    ranked = [sorted(able, key=lambda one: -score(rivalry, one[1], chosen.ways)) for rivalry in rivalries]
    tiles, names = [], []
    for number in range(count):
        rank, which = divmod(number, len(rivalries))
        name, start = ranked[which][rank % len(ranked[which])]
        file = kept / f"{number}.npy"
        if not file.is_file():
            rivalry = rivalries[which]
            asked = rivalry.question.name
            report(f"optimising tile {number + 1} of {count} for {asked}, starting from {name}")
            tile = climb(rivalry, start, chosen.ways, limits, place=chosen.places[0], steps=steps)
            with atomic_file(file) as temporary:
                np.save(temporary, tile)
        tiles.append(np.load(file))
        names.append(name)
    return tiles, names


def _repeats(level: np.ndarray) -> float:
    """Return how closely a layout repeats itself, as registration measures it.

    At a value of 1, the layout fits equally well at another shift.
    """
    topography = predicted_topography(level, SEARCH_BLUR_PX)
    return rival_alignment(topography, topography)
