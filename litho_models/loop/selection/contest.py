"""Candidates that promise much are fitted side by side: which the scans agree on, and what equals it.

A score test at the null predicts the gain of a small effect. For a large one it is a guess, and a
candidate that merely comes near may promise more than the true one delivers. So all that promise
a good part of the best gain are fitted in full before one is chosen.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from litho_data.foundation.workers import run_jobs
from litho_models.effects import Effect
from litho_models.effects.chain import EffectChain
from litho_models.loop.fold_fits import FREE_TERMS, FoldFits
from litho_models.loop.linear import pooled_cosine, without_scan_terms
from litho_models.loop.parameters import effect_slots
from litho_models.loop.screening.directions import Directions, measure_directions
from litho_models.loop.screening.eligibility import is_eligible, shortlist, terms_for
from litho_models.loop.screening.score_test import (
    SAME_COSINE,
    Screened,
    cosine,
    screen,
)
from litho_models.loop.selection.confirming import BINOMIAL_P, SMALLEST_SHARE, Confirmation
from litho_models.loop.study import Score, State, Study, fit_state, held_out_residuals
from litho_models.scan_terms import Terms

TRIES_PER_ROUND = 3
# Where none of the most promising is confirmed, the next ones are fitted.
HEATS = 3
# A member of a confusable set that loses this part of the gain in nearly every scan is told apart.
TOLD_APART_SHARE = 0.25
# The score test predicts the gain of a full fit within a factor of two or so.
WORTH_FITTING = 0.3


@dataclass(frozen=True)
class Added:
    """An effect taken into the model and the evidence for it."""

    effect: Effect
    confusable_with: list[str]
    before: Score
    after: Score
    confirmation: Confirmation
    p_screen: float

    @property
    def gain_nm2(self) -> float:
        """Mean gain in squared error on the scans left out."""
        return float((self.before.mse_nm2 - self.after.mse_nm2).mean())


@dataclass(frozen=True)
class Entrant:
    """A candidate with the model that has it, fitted jointly."""

    screened: Screened
    state: State

    @property
    def name(self) -> str:
        return self.screened.effect.name

    @property
    def training_error(self) -> np.ndarray:
        """Squared error on the training scans of each fold."""
        return self.state.fits.training_error


@dataclass
class Contest:
    """What one contest found: all screenings, the winner if one was confirmed, why others were not."""

    screened: list[Screened]
    winner: tuple[Added, State] | None = None
    failures: dict[str, str] = field(default_factory=dict)


def hold_contest(
    state: State,
    candidates: Sequence[Effect],
    study: Study,
    terms: Terms,
    *,
    holder: tuple[str, State] | None = None,
    refused: Collection[str] = (),
) -> Contest:
    """Screen the candidates, fit those that stand out, and confirm the one the training sets agree on.

    Args:
        state: the model without any of the candidates.
        candidates: effects that are not in it.
        terms: scan terms of the scoring.
        holder: a candidate that takes part whatever its screening says, and the fitted model with it.
        refused: candidates that are screened with the others and take no part.
    """
    if not candidates:
        return Contest([])
    directions = measure_directions(state.fits, study.windows, held_out_residuals(state, study), candidates)
    found = Contest(screen(directions, study.fold_of))
    mse_nm2 = float(state.score(study, terms).mse_nm2.mean())
    eligible = [s for s in found.screened if is_eligible(s, mse_nm2) and s.effect.name not in refused]
    study.report(f"{len(eligible)} of {len(found.screened)} candidates stand out")
    worth = WORTH_FITTING * SMALLEST_SHARE * mse_nm2
    for s in eligible:
        if s.mean_gain_nm2 < worth:
            found.failures[s.effect.name] = "predicted gain on held-out scans too small to matter"
    remaining = [s for s in eligible if s.mean_gain_nm2 >= worth]
    entrants, rejected = [], set()
    if holder is not None:
        entrants.append(Entrant(next(s for s in found.screened if s.effect.name == holder[0]), holder[1]))
    for _ in range(HEATS):
        entered = {*refused, *(e.name for e in entrants)}
        entering, relatives = (
            [s for s in group if s.effect.name not in entered]
            for group in shortlist(found.screened, remaining, directions)
        )
        entrants += _fitted(state, entering, study)
        standing = sorted(
            (e for e in entrants if e.name not in rejected), key=lambda e: float(e.training_error.sum())
        )
        changes = {e.name: _changes(state, e.state, study) for e in standing}
        for attempt, entrant in enumerate(standing[:TRIES_PER_ROUND]):
            alike = [
                rival
                for rival in standing
                if rival is not entrant
                and pooled_cosine(changes[entrant.name], changes[rival.name]) >= SAME_COSINE
            ]
            confusable = [r.name for r in alike if not _told_apart(state, entrant, r, study, terms)]
            confusable += _confusable_unfitted(entrant.screened, relatives, directions)
            agreeing, folds = _agreement(standing[attempt:], {entrant.name, *confusable})
            if agreeing < folds - 1:
                found.failures[entrant.name] = f"the best in only {agreeing} of {folds} training sets"
                continue
            added = judged(state, entrant, confusable, study, terms)
            if added.confirmation.passed:
                found.winner = added, entrant.state
                found.failures.pop(entrant.name, None)
                return found
            found.failures[entrant.name] = added.confirmation.reason
            rejected.add(entrant.name)
        fitted = {e.name for e in entrants}
        remaining = [s for s in remaining if s.effect.name not in fitted]
        if not remaining:
            break
    return found


def fold_amplitudes(fits: FoldFits, effect: Effect) -> dict[str, np.ndarray]:
    """Distance of each amplitude from its null in every fold, in typical sizes."""
    slots = effect_slots(fits.chain)
    amplitudes = {}
    for name in effect.amplitudes:
        parameter = effect.parameters[name]
        values = fits.per_fold[:, slots[effect.name, name]]
        amplitudes[name] = (values - parameter.null) / abs(parameter.typical - parameter.null)
    return amplitudes


def _fitted(state: State, entering: Sequence[Screened], study: Study) -> list[Entrant]:
    chain = state.fits.chain
    values = chain.values()
    jobs = [
        (s.effect.name, chain.with_effects({**values, s.effect.name: fitting_start(s)}), study)
        for s in entering
    ]
    fitted = {name: own for (name, *_), own in run_jobs(_fit, jobs, study.workers, name=lambda job: job[0])}
    return [Entrant(s, fitted[s.effect.name]) for s in entering]


def _fit(job: tuple[str, EffectChain, Study]) -> State:
    name, chain, study = job
    study.report(f"fitting {name}")
    return fit_state(chain, study)


def fitting_start(s: Screened) -> dict[str, float]:
    """The screened values, no amplitude farther from its null than its largest trial: the line ends there.

    A fit that starts beyond may end on the far side of a kink.
    """
    values = dict(s.values)
    for name in s.effect.amplitudes:
        null = s.effect.parameters[name].null
        reach = max(abs(trial.get(name, null) - null) for trial in s.effect.trials)
        values[name] = null + min(max(values[name] - null, -reach), reach)
    return values


def _confusable_unfitted(
    winner: Screened, relatives: Sequence[Screened], directions: Directions
) -> list[str]:
    """What cannot be distinguished from the winner without having been fitted itself."""
    alike = [s.effect.name for s in relatives if abs(cosine(directions, winner, s)) >= SAME_COSINE]
    # The same tilt and bow in all scans: printed so, or measured so.
    return [*alike, "tilt-bow"] if winner.projection == "no-bow" else alike


def judged(
    state: State,
    entrant: Entrant,
    confusable: Sequence[str],
    study: Study,
    terms: Terms,
) -> Added:
    """The entrant as it would be added to ``state``, with its confirmation on the scans left out."""
    effect, own = entrant.screened.effect, terms_for(terms, [entrant.screened])
    before, after = (s.score(study, own) for s in (state, entrant.state))
    confirmation = study.confirm(before, after, fold_amplitudes(entrant.state.fits, effect))
    return Added(effect, sorted(confusable), before, after, confirmation, entrant.screened.p)


def _agreement(entrants: Sequence[Entrant], names: set[str]) -> tuple[int, int]:
    """In how many training sets one of these names has the smallest error, and of how many."""
    best = np.argmin([e.training_error for e in entrants], axis=0)
    return sum(entrants[i].name in names for i in best), len(best)


def _told_apart(state: State, winner: Entrant, rival: Entrant, study: Study, terms: Terms) -> bool:
    """The rival is worse in nearly every held-out scan, by a good part of the gain."""
    own = terms_for(terms, [winner.screened, rival.screened])
    before, best, other = (s.score(study, own) for s in (state, winner.state, rival.state))
    verdict = study.confirm(other, best)
    gain, lost = before.mse_nm2.mean() - best.mse_nm2.mean(), other.mse_nm2.mean() - best.mse_nm2.mean()
    return verdict.p <= BINOMIAL_P and lost >= TOLD_APART_SHARE * gain


def _changes(before: State, after: State, study: Study) -> list[np.ndarray]:
    """What a candidate changes in the held-out predictions, freed of what single scans may add, µm."""
    changes = []
    for f, old, new in zip(study.scans, before.predictions, after.predictions, strict=True):
        changes.append(without_scan_terms(f.at_sample(new - old), f, old, FREE_TERMS))
    return changes
