"""What each candidate would gain on held-out scans, from its derivative at the model so far.

A candidate is a set of columns: secants of an effect at some of its parameters, or maps along a covariate.
Its strength is one for all scans or one by group. Of each scan only inner products are needed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import Effect
from litho_models.fitting.least_squares import gram_inside
from litho_models.loop.fits import State, Study
from litho_models.loop.trials import Secants, Trial, trials_of
from litho_models.scan_terms.grouped import ALL, Block, Labels, Products
from litho_models.scoring.statistics import sign_flips

# Of a direction's information, what must survive the projections for a test to mean anything.
SMALLEST_RETAINED = 1e-5
PERMUTATIONS = 199


@dataclass(frozen=True)
class Screened:
    """A trial with a way in which its strength goes, and what it gains on scans held out.

    Attributes:
        trial: what is tried; ``by``: the grouping of its strength.
        gains_nm2: (scans,) in squared error, strengths fitted without the scan's fold.
        multiples: by label, of the trial's amplitudes, from all scans.
        allowed: the strengths have a physical sign; ``retained``: share of the information that the terms of
            single scans and the model's own numbers leave, ``beside_base``: what the terms alone leave.
    """

    trial: Trial
    by: str
    gains_nm2: np.ndarray
    multiples: Mapping[str, np.ndarray]
    allowed: bool
    retained: float
    beside_base: float

    @property
    def name(self) -> str:
        return self.trial.effect.name

    @property
    def gain_nm2(self) -> float:
        return float(self.gains_nm2.mean())

    @property
    def numbers(self) -> int:
        return len(self.trial.sets) * len(self.multiples)

    def start(self) -> dict[str, dict[str, float]]:
        """Values by label from which a fit begins."""
        return {label: self.trial.start(own) for label, own in self.multiples.items()}


class Screening:
    """Secants of all trials, and their inner products with what a fitted state leaves.

    Args:
        state: the model so far; ``study``: its scans; ``effects``: candidates, none of them in the model.
        secants: at another model, near enough to tell what is worth fitting; by default at the state.
        kept: numbers of the model that residual and columns are not freed of.
    """

    def __init__(
        self,
        state: State,
        study: Study,
        effects: Sequence[Effect],
        secants: Secants | None = None,
        kept: Collection[int] = (),
    ):
        self.study = study
        own = len(state.twin.vector)
        self.trials = trials_of(effects, 1 + own)
        secants = secants or Secants(state.twin, study.windows)
        secants.learn(self.trials)
        grams, raw = [], np.array(1e-300)
        for at, (left, part) in enumerate(zip(state.held_out_um, state.linear, strict=True)):
            stacked = np.column_stack([left, *part.jacobian, *secants.of(self.trials, at)])
            whole = stacked.T @ stacked / len(stacked)
            grams.append(whole - gram_inside(stacked, secants.free_terms(at)) / len(stacked))
            raw = raw + np.diag(whole)
        products = Products(np.stack(grams), study.groups)
        self.freed = products.freed_of([Block((1 + i,)) for i in range(own) if i not in kept]).grams
        self._beside_base, self._retained = (
            np.einsum("sii->i", one) / raw for one in (products.grams, self.freed)
        )

    @cached_property
    def candidates(self) -> list[Screened]:
        """The best trial of each effect in each grouping, the largest gain first."""
        found: dict[tuple[str, str], Screened] = {}
        for trial in self.trials:
            for by in self.study.groups:
                one = self._candidate(trial, by)
                best = found.get((one.name, by))
                if best is None or (one.allowed, one.gain_nm2) > (best.allowed, best.gain_nm2):
                    found[one.name, by] = one
        return sorted(found.values(), key=lambda one: -one.gain_nm2)

    def cosine(self, a: Screened, b: Screened) -> float:
        """Alignment of what two candidates change, pooled over scans."""
        one, other = self._change(a), self._change(b)
        inner = np.einsum("asi,sij,bsj->ab", [one, other], self.freed, [one, other], optimize=True)
        return float(inner[0, 1] / max(np.sqrt(inner[0, 0] * inner[1, 1]), 1e-300))

    def _change(self, one: Screened) -> np.ndarray:
        """Multiples of all columns, (scans, columns), in what a candidate changes."""
        found = np.zeros(self.freed.shape[:2])
        found[:, one.trial.columns] = [one.multiples[label] for label in self.study.groups[one.by]]
        return found

    def permutation_p(self, one: Screened) -> float:
        """See ``permutation_p``."""
        labels = self.study.groups[one.by]
        return permutation_p(self.study, labels, one.gain_nm2, lambda by: self._gains(one.trial, by)[0])

    def family_p(self, one: Screened) -> float:
        """Share of flips of the signs of the scans whose largest gain of any candidate reaches this one's."""
        return float(np.mean(self._largest >= one.gains_nm2.sum() * (1 - 1e-9)))

    @cached_property
    def _largest(self) -> np.ndarray:
        """Largest sum of gains over the candidates of one strength, for each flip of the scans' signs."""
        gains = np.stack([one.gains_nm2 for one in self.candidates if one.by == ALL], axis=1)
        return (sign_flips(len(gains), self.study.seed) @ gains).max(axis=1)

    def _candidate(self, trial: Trial, by: str) -> Screened:
        gains, multiples = self._gains(trial, self.study.groups[by])
        largest = max(trial.sizes(own).max() for own in multiples.values())
        return Screened(
            trial=trial,
            by=by,
            gains_nm2=gains,
            multiples=multiples,
            allowed=all(trial.allowed(own, largest) for own in multiples.values()),
            retained=float(self._retained[trial.columns].max()),
            beside_base=float(self._beside_base[trial.columns].max()),
        )

    def _gains(self, trial: Trial, labels: Labels) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Held-out gains (scans,) nm², and the multiples by label from all scans."""
        return gains_by(
            self.freed,
            self.study.fold_of,
            trial.columns,
            labels,
            lambda own: trial.allowed(own) * trial.reach(own),
        )


def gains_by(
    grams: np.ndarray,
    fold_of: np.ndarray,
    columns: Sequence[int],
    labels: Labels,
    taken: Callable[[np.ndarray], float] = lambda multiples: 1.0,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Held-out gains (scans,) nm² of some columns with strengths by label, and those from all scans.

    Args:
        grams: (scans, 1 + m, 1 + m), residual first, µm²; ``taken``: share of the strengths that is taken.
    """
    own, members = np.array(columns), np.array(labels)
    scores, infos = grams[:, own, 0], grams[:, own[:, None], own[None, :]]
    gains, multiples = np.zeros(len(grams)), {}
    for label in dict.fromkeys(labels):
        inside = members == label
        total_score, total_info = scores[inside].sum(axis=0), infos[inside].sum(axis=0)
        multiples[label] = _solved(total_info, total_score)
        for fold in np.unique(fold_of[inside]):
            out = inside & (fold_of == fold)
            if out.sum() < inside.sum():
                found = _solved(total_info - infos[out].sum(axis=0), total_score - scores[out].sum(axis=0))
                found = found * taken(found)
                gains[out] = 2 * scores[out] @ found - np.einsum("i,sij,j->s", found, infos[out], found)
    return gains * NM_PER_UM**2, multiples


def permutation_p(
    study: Study, labels: Labels, gain_nm2: float, gains_of: Callable[[Labels], np.ndarray]
) -> float:
    """Share of exchanges of the scans after which a strength by any grouping gains as much as by ``labels``.

    An exchange that leaves every scan beside the same others changes nothing, and is not counted.
    """
    groupings = [np.array(own) for by, own in study.groups.items() if by != ALL]
    rng, judged = np.random.default_rng(study.seed), _beside(np.array(labels))
    exchanged = beaten = 0
    for _ in range(PERMUTATIONS):
        order = rng.permutation(len(study.scans))
        moved = [own[order] for own in groupings]
        if any((_beside(own) == judged).all() for own in moved):
            continue
        exchanged += 1
        beaten += any(gains_of(tuple(own)).mean() >= gain_nm2 * (1 - 1e-12) for own in moved)
    return (1 + beaten) / (1 + exchanged)


def _beside(labels: np.ndarray) -> np.ndarray:
    """Which scans (n, n) share a label."""
    return labels[:, None] == labels[None, :]


def _solved(info: np.ndarray, score: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(info, score, rcond=1e-8)[0]
