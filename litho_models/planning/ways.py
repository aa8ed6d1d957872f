"""How the prints are to be scanned and where they lie: what separates the rivals most, no more than that."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_models.loop.result.questions import Question
from litho_models.planning.layouts import score
from litho_models.planning.rivalry import Place, Rivalry, Way

TURNED = Way(turned_deg=90)
_EXTRAS = (TURNED, Way(backward=True), Way(new_tip=True))
_MOST_EXTRAS = 2
# A further scan is worth its time if it brings rivals apart by this factor.
_WORTH = 1.3
# Below this many standard deviations a layout shows nothing of the difference.
_NOTHING = 0.3
WORDS = {
    TURNED: "turned by 90°: what lies along the scan lines turns with them, what lies along the written "
    "lines does not",
    Way(backward=True): "in the other direction: what lags behind changes sides",
    Way(
        new_tip=True
    ): "with a new, sharp tip: what the tip adds is gone, what was printed stays; turning the "
    "print shows nothing of a round tip",
}


def choose_ways(
    rivalry: Rivalry, level: np.ndarray, can_move: bool
) -> tuple[tuple[Way, ...], Place, dict[str, float]]:
    """Scans of each print, and the place of the prints in the write field.

    Args:
        rivalry: the rivals.
        level: a layout to try the ways on.
        can_move: whether the write field is larger than a print and known.

    Returns:
        ways, place, and the separation in standard deviations by one scan and by each way beside it.
    """
    ways: tuple[Way, ...] = (Way(),)
    reached = score(rivalry, level, ways)
    tried = {"one plain scan": reached}
    for _ in range(_MOST_EXTRAS):
        scores = {}
        for extra in _EXTRAS:
            if extra not in ways:
                scores[extra] = score(rivalry, level, (*ways, extra))
                # What each does beside one plain scan; later ones only add to it.
                tried.setdefault(f"a scan {WORDS[extra].split(':')[0]}", scores[extra])
        best = max(scores, key=lambda way: scores[way])
        if scores[best] < max(_WORTH * reached, _NOTHING):
            break
        ways, reached = (*ways, best), scores[best]
    place: Place = "centre"
    if can_move:
        at_edge = score(rivalry, level, ways, "edge")
        tried["at the edge of the write field"] = at_edge
        if at_edge >= max(_WORTH * reached, _NOTHING):
            place = "edge"
    return ways, place, tried


def ways_without_rivals(questions: Sequence[Question]) -> tuple[Way, ...]:
    """Scans asked for by questions whose answer depends on no layout."""
    turned = any(
        q.kind == "lines" or (q.turning is not None and q.turning.by == "turned scan") for q in questions
    )
    repeated = any(q.kind == "per-scan" for q in questions)
    # A scan turned by 90 degrees is a repeat as well: the print was taken out and put back.
    return (TURNED,) if turned or repeated else ()
