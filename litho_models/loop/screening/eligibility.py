"""Which screened candidates take part in a contest, and under which per-scan terms they are compared."""

from __future__ import annotations

from collections.abc import Sequence

from litho_models.loop.screening.directions import PROJECTIONS, Directions
from litho_models.loop.screening.score_test import FAMILY_P, SAME_COSINE, SMALLEST_RETAINED, Screened, cosine
from litho_models.loop.selection.confirming import SMALLEST_SHARE
from litho_models.scan_terms import Terms, line_terms

# Promising this part of the best predicted gain is enough to be fitted.
CONTENDER_SHARE = 0.5
MOST_CONTENDERS, MOST_RELATIVES = 4, 3


def may_be(s: Screened) -> bool:
    """Physical, testable and of some use: enough for a member of a set of which another stands out."""
    return s.in_range and s.retained >= SMALLEST_RETAINED and s.mean_gain_nm2 > 0


def is_eligible(s: Screened, mse_nm2: float) -> bool:
    """Physical, testable, promises a gain on held-out scans, and stands out.

    To stand out: family-wise by the score test or, where few scans leave that test little power, by
    a gain that would matter on scans not used for its estimate. Whether it is real, the fit decides.
    """
    return may_be(s) and (s.p <= FAMILY_P or s.mean_gain_nm2 >= SMALLEST_SHARE * mse_nm2)


def terms_for(terms: Terms, screened: Sequence[Screened]) -> Terms:
    """Per-scan terms of the comparison without and with effects: those that the fit leaves free.

    Registration has already taken the mean shift and magnification out of every scan, so an effect that
    has them must not be charged for them; what acts as a gain, as a distortion, or line by line, must not
    be hidden by the scans' own.
    """
    free = (terms | {"warp"}) - {"distortion"}
    for s in screened:
        free -= PROJECTIONS["full"] - PROJECTIONS[s.projection]
    lines = {term.name for term in line_terms(free)}
    return free - lines if any(s.effect.along_lines for s in screened) else free


def shortlist(
    screened: Sequence[Screened], eligible: Sequence[Screened], directions: Directions
) -> tuple[list[Screened], list[Screened]]:
    """Those to fit, and what looks like the first of them but is one too many to fit."""
    if not eligible:
        return [], []
    first = eligible[0]
    contenders = [s for s in eligible if s.mean_gain_nm2 >= CONTENDER_SHARE * first.mean_gain_nm2]
    contenders = contenders[:MOST_CONTENDERS]
    relatives = [
        s
        for s in screened
        if s not in contenders and may_be(s) and abs(cosine(directions, first, s)) >= SAME_COSINE
    ]
    return contenders + relatives[:MOST_RELATIVES], relatives[MOST_RELATIVES:]
