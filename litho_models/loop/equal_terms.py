"""Errors before and after with the same terms per scan: what a corrected model gains beside more freedom."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

from litho_models.loop.choice import Choice
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.study import Score, score
from litho_models.scan_terms import POLICIES, Terms
from litho_models.scan_terms.background import learn_background
from litho_models.scoring.records import Prediction

# Policies of the benchmark, and what the loop accepted for single scans.
TermSet = Literal["none", "offset", "offset-gain", "full", "accepted"]
BeforeAfter = tuple[Score, Score]


def term_sets(accepted: Terms) -> dict[TermSet, Terms]:
    """Terms per scan by name."""
    return {name: accepted if name == "accepted" else POLICIES[name] for name in get_args(TermSet)}


def scores(choice: Choice) -> dict[TermSet, BeforeAfter]:
    """Held-out errors of the scans that were chosen on, each by the fits that have not seen it."""
    states = choice.base, choice.final
    return {
        name: (states[0].score(choice.study, terms), states[1].score(choice.study, terms))
        for name, terms in term_sets(choice.terms).items()
    }


def scores_elsewhere(choice: Choice, scans: Sequence[PreparedScan]) -> dict[TermSet, BeforeAfter]:
    """Errors of scans that took no part in the choice, by the fits to all that did."""
    study, maps = choice.study, []
    for predict in (choice.before, choice.after):
        learned = None
        if study.background == "training":
            learned = learn_background([s.stored for s in study.scans], [predict(s) for s in study.scans])
        maps.append([Prediction.beside(learned, predict(scan)).map_um for scan in scans])
    return {
        name: (score(scans, maps[0], terms, study.blocks), score(scans, maps[1], terms, study.blocks))
        for name, terms in term_sets(choice.terms).items()
    }
