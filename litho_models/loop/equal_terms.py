"""Errors before and after with the same terms per scan: what a corrected model gains beside more freedom."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np

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
    return {
        name: (choice.base.score(choice.study, terms), choice.final.score(choice.study, terms))
        for name, terms in term_sets(choice.terms).items()
    }


def scores_elsewhere(choice: Choice, scans: Sequence[PreparedScan]) -> dict[TermSet, BeforeAfter]:
    """Errors of scans that took no part in the choice, by the fits to all that did."""
    before, after = predictions_elsewhere(choice, scans)
    blocks = choice.study.blocks
    return {
        name: (score(scans, before, terms, blocks), score(scans, after, terms, blocks))
        for name, terms in term_sets(choice.terms).items()
    }


def predictions_elsewhere(
    choice: Choice, scans: Sequence[PreparedScan]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Maps (y, x), µm, of scans that took no part in the choice, by the base and by the final model.

    With the background of the scans that it was made on, if their study has one.
    """
    study = choice.study

    def maps(predict: Callable[[PreparedScan], np.ndarray]) -> list[np.ndarray]:
        learned = None
        if study.background == "training":
            learned = learn_background([s.stored for s in study.scans], [predict(s) for s in study.scans])
        return [Prediction.beside(learned, predict(scan)).map_um for scan in scans]

    return maps(choice.before), maps(choice.after)
