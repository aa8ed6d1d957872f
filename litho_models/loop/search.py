"""Forward selection of effects: screen, group what looks alike, fit, confirm on held-out scans, repeat."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from litho_models.effects import Effect, get_effect, screened_effects
from litho_models.effects.chain import EffectChain
from litho_models.loop.confirming import BINOMIAL_P, SMALLEST_SHARE, Confirmation, binomial_p, confirm
from litho_models.loop.fields import Field
from litho_models.loop.fitting import FoldFits, effect_slots, fit_folds, predict
from litho_models.loop.scoring import Score, Terms, score
from litho_models.loop.screening import (
    FAMILY_P,
    SAME_COSINE,
    SMALLEST_RETAINED,
    Screened,
    best_by_fold,
    cosine,
    measure_directions,
    screen,
)

MOST_EFFECTS = 8
TRIES_PER_ROUND = 3
# A member of a confusable set that loses this part of the gain in nearly every scan is told apart.
TOLD_APART_SHARE = 0.25
REFITTED_MEMBERS = 3
# The score test predicts the gain of a full fit within a factor of two or so.
WORTH_FITTING = 0.3


@dataclass(frozen=True)
class State:
    """A fitted model and its held-out predictions (y, x) µm, one per scan."""

    fits: FoldFits
    predictions: list[np.ndarray]


@dataclass(frozen=True)
class Added:
    """An effect taken into the model and the evidence for it."""

    effect: Effect
    confusable_with: list[str]
    before: Score
    after: Score
    confirmation: Confirmation
    p_screen: float


@dataclass
class Search:
    """What the selection found.

    ``first``, ``last``: first and latest screening of every candidate.
    ``failures``: effect to why it was not confirmed.
    ``dropped``: added and not needed later; ``absorbed``: only the stiff model lacks it.
    """

    state: State
    added: list[Added] = field(default_factory=list)
    first: dict[str, Screened] = field(default_factory=dict)
    last: dict[str, Screened] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    dropped: dict[str, str] = field(default_factory=dict)
    absorbed: dict[str, str] = field(default_factory=dict)


def fit_state(chain: EffectChain, fields: Sequence[Field], fold_of: np.ndarray) -> State:
    """Fit the chain per fold and predict every scan with the fit that has not seen it."""
    fits = fit_folds(chain, [field.window for field in fields], fold_of)
    return State(fits, [predict(fits.chain, fits.per_fold[fold_of[i]], f) for i, f in enumerate(fields)])


def held_out_residuals(state: State, windows: Sequence[Field], fold_of: np.ndarray) -> list[np.ndarray]:
    """Measured minus predicted (n,) µm at the sampled pixels, each scan by the fit that has not seen it."""
    fits = state.fits
    return [
        w.height - w.at_sample(predict(fits.chain, fits.per_fold[fold], w))
        for w, fold in zip(windows, fold_of, strict=True)
    ]


def search_effects(
    start: State,
    fields: Sequence[Field],
    fold_of: np.ndarray,
    terms: Terms,
    *,
    exclude: Mapping[str, str],
    floor_nm2: float,
    seed: int,
    report: Callable[[str], None] = lambda message: None,
) -> Search:
    """Add effects one at a time while one is confirmed.

    Args:
        start: the base model.
        fields: development scans; ``fold_of``: fold that holds each out.
        terms: per-scan terms of the scoring.
        exclude: effects that cannot be tested here, with the reason.
        floor_nm2: squared noise floor or its lower bound.
        report: told in a sentence what happens.
    """
    found = Search(start)
    while len(found.added) < MOST_EFFECTS:
        candidates = [
            effect
            for effect in screened_effects()
            if effect.name not in exclude and effect.name not in found.state.fits.chain.names
        ]
        added = _one_round(found, candidates, fields, fold_of, terms, floor_nm2, seed, report)
        if not added:
            break
    _drop_idle(found, fields, fold_of, terms, floor_nm2, seed, report)
    return found


def _one_round(
    found: Search,
    candidates: list[Effect],
    fields: Sequence[Field],
    fold_of: np.ndarray,
    terms: Terms,
    floor_nm2: float,
    seed: int,
    report: Callable[[str], None],
) -> bool:
    if not candidates:
        return False
    state = found.state
    fits = state.fits
    windows = [field.window for field in fields]
    residuals = held_out_residuals(state, windows, fold_of)
    directions = measure_directions(fits.chain, fits.common, fits.linear, windows, residuals, candidates)
    screened = screen(directions, fold_of)
    found.last = {s.effect.name: s for s in screened}
    for s in screened:
        found.first.setdefault(s.effect.name, s)
    mse_nm2 = float(score(fields, state.predictions, terms, seed).mse_nm2.mean())
    eligible = [s for s in screened if is_eligible(s, mse_nm2)]
    report(f"{len(eligible)} of {len(screened)} candidates stand out")
    for attempt in range(min(TRIES_PER_ROUND, len(eligible))):
        chosen = eligible[attempt]
        if chosen.mean_gain_nm2 < WORTH_FITTING * SMALLEST_SHARE * mse_nm2:
            found.failures[chosen.effect.name] = "predicted gain on held-out scans too small to matter"
            continue
        alike = [
            s
            for s in screened
            if s is not chosen and may_be(s) and abs(cosine(directions, chosen, s)) >= SAME_COSINE
        ]
        winners = best_by_fold(directions, eligible[attempt:], fold_of)
        same = {chosen.effect.name, *(s.effect.name for s in alike)}
        agreeing = sum(winner in same for winner in winners)
        if agreeing < len(winners) - 1:
            found.failures[chosen.effect.name] = f"chosen in only {agreeing} of {len(winners)} training sets"
            continue
        added = _fit_and_confirm(state, chosen, alike, fields, fold_of, terms, floor_nm2, seed, report)
        if added[0].confirmation.passed:
            found.added.append(added[0])
            found.state = added[1]
            found.failures.pop(added[0].effect.name, None)
            return True
        found.failures[added[0].effect.name] = added[0].confirmation.reason
    return False


def may_be(s: Screened) -> bool:
    """Physical, testable and of some use: enough for a member of a set of which another stands out."""
    return s.in_range and s.retained >= SMALLEST_RETAINED and s.mean_gain_nm2 > 0


def is_eligible(s: Screened, mse_nm2: float) -> bool:
    """Physical, testable, promises a gain on held-out scans, and stands out.

    To stand out: family-wise by the score test or, where few scans leave that test little power, by
    a gain on scans not used for its estimate that satisfies the rules of the confirmation by itself.
    """
    if not may_be(s):
        return False
    improved = int((s.gain_nm2 > 0).sum())
    consistent = binomial_p(improved, len(s.gain_nm2)) <= BINOMIAL_P
    return s.p <= FAMILY_P or (consistent and s.mean_gain_nm2 >= SMALLEST_SHARE * mse_nm2)


def _fit_and_confirm(
    state: State,
    chosen: Screened,
    alike: list[Screened],
    fields: Sequence[Field],
    fold_of: np.ndarray,
    terms: Terms,
    floor_nm2: float,
    seed: int,
    report: Callable[[str], None],
) -> tuple[Added, State]:
    own_terms = terms_for(terms, chosen)
    before = score(fields, state.predictions, own_terms, seed)
    members = [chosen, *sorted(alike, key=lambda s: -s.mean_gain_nm2)]
    refitted = []
    for member in members[: 1 + REFITTED_MEMBERS]:
        report(f"fitting {member.effect.name}")
        extended = state.fits.chain.with_effects(
            {**state.fits.chain.values(), member.effect.name: member.values}
        )
        fitted = fit_state(extended, fields, fold_of)
        refitted.append((member, fitted, score(fields, fitted.predictions, own_terms, seed)))
    best = min(refitted, key=lambda entry: entry[2].mse_nm2.mean())
    untold = [s.effect.name for s in members[1 + REFITTED_MEMBERS :]]
    for member, _, after in refitted:
        if member is not best[0] and not _told_apart(before, best[2], after, seed):
            untold.append(member.effect.name)
    confirmation = confirm(
        before.mse_nm2,
        best[2].mse_nm2,
        before.mae_nm,
        best[2].mae_nm,
        floor_nm2=floor_nm2,
        amplitudes=fold_amplitudes(best[1].fits, best[0].effect),
        seed=seed,
    )
    return Added(best[0].effect, sorted(untold), before, best[2], confirmation, best[0].p), best[1]


def terms_for(terms: Terms, screened: Screened) -> Terms:
    """Per-scan terms of the comparison without and with an effect: those that the fit leaves free.

    Registration has already taken the mean shift and magnification out of every scan, so an effect that
    has them must not be charged for them; what acts as a gain must not be hidden by the scans' own gain.
    """
    free = terms | {"warp"}
    return free - {"gain"} if screened.projection == "no-gain" else free


def fold_amplitudes(fits: FoldFits, effect: Effect) -> dict[str, np.ndarray]:
    """Distance of each amplitude from its null in every fold, in typical sizes."""
    slots = effect_slots(fits.chain)
    amplitudes = {}
    for name in effect.amplitudes:
        parameter = effect.parameters[name]
        values = fits.per_fold[:, slots[effect.name, name]]
        amplitudes[name] = (values - parameter.null) / abs(parameter.typical - parameter.null)
    return amplitudes


def _told_apart(before: Score, best: Score, other: Score, seed: int) -> bool:
    verdict = confirm(other.mse_nm2, best.mse_nm2, other.mae_nm, best.mae_nm, seed=seed)
    gain, lost = before.mse_nm2.mean() - best.mse_nm2.mean(), other.mse_nm2.mean() - best.mse_nm2.mean()
    return verdict.p <= BINOMIAL_P and lost >= TOLD_APART_SHARE * gain


def _drop_idle(
    found: Search,
    fields: Sequence[Field],
    fold_of: np.ndarray,
    terms: Terms,
    floor_nm2: float,
    seed: int,
    report: Callable[[str], None],
) -> None:
    """One backward pass: an effect whose removal costs nothing leaves again."""
    for entry in list(found.added[:-1]):
        name = entry.effect.name
        report(f"checking whether {name} is still needed")
        chain = found.state.fits.chain
        kept = {other: values for other, values in chain.values().items() if other != name}
        without = fit_state(chain.with_effects(kept), fields, fold_of)
        own_terms = terms_for(terms, found.first[name])
        before = score(fields, without.predictions, own_terms, seed)
        after = score(fields, found.state.predictions, own_terms, seed)
        still = confirm(
            before.mse_nm2, after.mse_nm2, before.mae_nm, after.mae_nm, floor_nm2=floor_nm2, seed=seed
        )
        if not still.passed:
            found.added.remove(entry)
            found.dropped[name] = f"not needed once the others were added: {still.reason}"
            found.state = without


def separating_experiment(names: Sequence[str]) -> str:
    """What would tell the members of a set apart."""
    experiments = dict.fromkeys(get_effect(name).separating for name in names)
    return "; ".join(text for text in experiments if text)
