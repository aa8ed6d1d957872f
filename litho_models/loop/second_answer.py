"""A second answer beside turning: what a grating of known size shows of the scanner and of the tip."""

from __future__ import annotations

from collections.abc import Sequence

from litho_data.build.gratings import GratingScan
from litho_data.foundation.units import NM_PER_UM
from litho_models.effects.registry import TIP
from litho_models.loop.decision_error import Z_DECIDED
from litho_models.loop.result.questions import Question

SCANNER = "piezo-nonlinearity"


def said_by_gratings(question: Question, gratings: Sequence[GratingScan], line_um: float) -> str:
    """What gratings say of a question about the scanner or the tip; empty if they say nothing of it.

    A rival asks for what the first round fitted; what the grating shows lies above half of that or below.

    Args:
        question: with its rivals.
        line_um: length of a line of the prints.
    """
    told = []
    for rival in question.rivals:
        if rival.name not in (SCANNER, TIP):
            continue
        own = rival.effects[rival.name]
        for one in gratings:
            if rival.name == TIP and one.tip_at_most_um is not None:
                told.append(_of_tip(one.tip_at_most_um, own["radius_um"]))
            elif rival.name == SCANNER and one.bow_um is not None and one.bow_sd_um is not None:
                # A displacement that is quadratic grows with the square of the line.
                scaled = (line_um / one.line_um) ** 2
                told.append(
                    _of_bow(scaled * one.bow_um, scaled * one.bow_sd_um, own["strength"] * line_um / 4)
                )
    return "; ".join(told)


def _of_bow(shown_um: float, sd_um: float, asked_um: float) -> str:
    towards = (shown_um - asked_um / 2) * (1 if asked_um > 0 else -1)
    if abs(towards) < Z_DECIDED * sd_um:
        told = "too near to halfway to say more"
    else:
        told = "it is the scanner's" if towards > 0 else "it is not the scanner's"
    shown_nm, sd_nm, asked_nm = (NM_PER_UM * one for one in (shown_um, sd_um, asked_um))
    return (
        f"a grating shows the middle of a line {shown_nm:.1f} ± {sd_nm:.1f} nm off, {SCANNER} asks for "
        f"{asked_nm:.0f} nm: {told}"
    )


def _of_tip(most_um: float, asked_um: float) -> str:
    told = "it is not the tip's" if most_um < asked_um / 2 else "it says no more"
    return f"a grating shows a tip of {most_um:.2f} µm at most, {TIP} asks for {asked_um:.2f} µm: {told}"
