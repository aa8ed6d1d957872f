"""What each candidate would gain on held-out scans, from its derivative at the model so far.

A candidate is a set of columns: secants of an effect at some of its parameters, or maps along a covariate.
Its strength is one for all scans or one by group. Of each scan only inner products are needed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import Effect, get_effect
from litho_models.fitting.least_squares import gram_inside, orthonormal
from litho_models.loop.fits import ALL_FREE, State, Study
from litho_models.loop.model import Twin, finished
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms.grouped import ALL, Block, Labels, Products
from litho_models.scoring.statistics import sign_flips

# Of a direction's information, what must survive the projections for a test to mean anything.
SMALLEST_RETAINED = 1e-5
# A strength on the wrong side of its null counts as noise if it is smaller than this share of the largest.
_NOISE_SHARE = 0.3
PERMUTATIONS = 199


@dataclass(frozen=True)
class Trial:
    """Parameter sets of one effect of one shape and size; their amplitudes are fitted together."""

    effect: Effect
    sets: tuple[Mapping[str, float], ...]

    def values(self, multiples: np.ndarray) -> dict[str, float]:
        """Parameter values for these multiples of the amplitudes, within their ranges."""
        values = dict(self.effect.off_values())
        for multiple, trial in zip(multiples, self.sets, strict=True):
            for name, value in trial.items():
                facts = self.effect.parameters[name]
                if facts.kind == "amplitude":
                    values[name] += float(multiple) * (value - facts.null)
                else:
                    values[name] = value
        return values

    def sizes(self, multiples: np.ndarray) -> dict[str, float]:
        """Of each amplitude its distance from its null, in those of ordinary values."""
        values = self.values(multiples)
        named = {n for trial in self.sets for n in trial} & set(self.effect.amplitudes)
        facts = {name: self.effect.parameters[name] for name in named}
        return {n: abs(values[n] - f.null) / abs(f.typical - f.null) for n, f in facts.items()}

    def allowed(self, multiples: np.ndarray, largest: float = 0.0) -> bool:
        """No amplitude on the wrong side of a null that bounds it, unless noise may have put it there.

        Noise is what is small beside the largest amplitude, or beside ``largest``, that of any group.
        """
        values, sizes = self.values(multiples), self.sizes(multiples)
        facts = {name: self.effect.parameters[name] for name in sizes}
        wrong = [
            n for n, f in facts.items() if (values[n] < f.null <= f.lower) or (values[n] > f.null >= f.upper)
        ]
        return not any(sizes[n] > _NOISE_SHARE * max(largest, *sizes.values()) for n in wrong)

    def reach(self, multiples: np.ndarray) -> float:
        """Share of the step that stays within the ranges: a straight line from the null overshoots."""
        values, share = self.values(multiples), 1.0
        for name in self.effect.amplitudes:
            facts = self.effect.parameters[name]
            step = values[name] - facts.null
            room = (facts.upper if step > 0 else facts.lower) - facts.null
            if abs(room) < abs(step) and room != 0:
                share = min(share, room / step)
        return share


@dataclass(frozen=True)
class Screened:
    """A trial with a way in which its strength goes, and what it gains on scans held out.

    Attributes:
        trial: what is tried; ``by``: the grouping of its strength.
        gains_nm2: (scans,) in squared error, strengths fitted without the scan's fold.
        multiples: by label, of the trial's amplitudes, from all scans.
        columns: of the trial in the inner products.
        allowed: the strengths have a physical sign; ``retained``: share of the information that the terms of
            single scans and the model's own numbers leave, ``beside_base``: what the terms alone leave.
    """

    trial: Trial
    by: str
    gains_nm2: np.ndarray
    multiples: Mapping[str, np.ndarray]
    columns: tuple[int, ...]
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
        return len(self.columns) * len(self.multiples)

    def start(self) -> dict[str, dict[str, float]]:
        """Values by label from which a fit begins, no farther from the null than the largest trial."""
        found = {}
        for label, multiples in self.multiples.items():
            values = self.trial.values(multiples * self.trial.reach(multiples))
            for name in self.trial.effect.amplitudes:
                facts = self.trial.effect.parameters[name]
                far = max(abs(trial.get(name, facts.null) - facts.null) for trial in self.trial.effect.trials)
                step = min(max(values[name] - facts.null, -far), far)
                values[name] = min(max(facts.null + step, facts.lower), facts.upper)
            found[label] = values
        return found


def trials_of(effects: Sequence[Effect]) -> list[Trial]:
    """The trials of the effects by shape and size.

    A second trial of the same amplitudes at the same shape is another size: what an effect does when it is
    large need not be a multiple of what it does when it is small.
    """
    found = []
    for effect in effects:
        by_shape: dict[tuple[object, ...], list[Mapping[str, float]]] = {}
        for trial in effect.trials:
            shape = tuple(sorted((k, v) for k, v in trial.items() if k not in effect.amplitudes))
            size = 0
            while any(set(other) == set(trial) for other in by_shape.get((shape, size), [])):
                size += 1
            by_shape.setdefault((shape, size), []).append(trial)
        found += [Trial(effect, tuple(own)) for own in by_shape.values()]
    return found


class Secants:
    """What trials change in the windows at a model; what is known of one is not computed again."""

    def __init__(self, twin: Twin, windows: Sequence[PreparedScan]):
        self._placed, self._windows = twin.placed(), windows
        self._known: dict[tuple[str, tuple[object, ...]], list[NDArray[np.float32]]] = {}

    def learn(self, trials: Sequence[Trial]) -> None:
        """Compute what is not known yet."""
        new = {
            (trial.effect.name, tuple(values.items())): trial.effect.with_values(values)
            for trial in trials
            for values in trial.sets
        }
        new = {key: values for key, values in new.items() if key not in self._known}
        self._known |= {key: [] for key in new}
        for window in self._windows if new else ():
            chain = self._placed.chain(window)
            base = self._placed.base_height(chain, window)
            here = finished(chain, base, window)
            for (name, at), values in new.items():
                moved = self._placed.chain(window, {name: values})
                same = get_effect(name).acts_on == "height"
                height = base if same else self._placed.base_height(moved, window)
                change = window.at_sample(finished(moved, height, window) - here)
                self._known[name, at].append(change.astype(np.float32))

    def of(self, trials: Sequence[Trial], number: int) -> list[NDArray[np.float32]]:
        """Changes (n,), µm, in one window, a row for each set of each trial."""
        return [
            self._known[trial.effect.name, tuple(values.items())][number]
            for trial in trials
            for values in trial.sets
        ]

    def free_terms(self, number: int) -> np.ndarray:
        """Orthonormal basis (n, k) of what one window may add by itself."""
        window = self._windows[number]
        return orthonormal(window.terms_at_sample(self._placed.height(window), ALL_FREE).T)


class Screening:
    """Secants of all trials, and their inner products with what a fitted state leaves.

    Args:
        state: the model so far; ``study``: its scans; ``effects``: candidates, none of them in the model.
        secants: at another model, near enough to tell what is worth fitting; by default at the state.
    """

    def __init__(self, state: State, study: Study, effects: Sequence[Effect], secants: Secants | None = None):
        self.study = study
        self.trials = trials_of(effects)
        self._own = len(state.twin.vector)
        secants = secants or Secants(state.twin, study.windows)
        secants.learn(self.trials)
        count = 1 + self._own + sum(len(trial.sets) for trial in self.trials)
        grams = np.empty((len(study.scans), count, count))
        raw = np.zeros(count)
        for at in range(len(study.scans)):
            columns = [state.held_out_um[at], *state.linear[at].jacobian, *secants.of(self.trials, at)]
            stacked, basis = np.column_stack(columns), secants.free_terms(at)
            whole = stacked.T @ stacked / len(stacked)
            grams[at] = whole - gram_inside(stacked, basis) / len(stacked)
            raw += np.diag(whole)
        own = [Block((1 + i,)) for i in range(self._own)]
        self._raw = np.maximum(raw, 1e-300)
        self._beside_base = np.einsum("sii->i", grams) / self._raw
        self.freed = Products(grams, study.groups).freed_of(own).grams
        self._retained = np.einsum("sii->i", self.freed) / self._raw

    @cached_property
    def columns(self) -> list[tuple[int, ...]]:
        """Of each trial, its columns in the inner products."""
        found, at = [], 1 + self._own
        for trial in self.trials:
            found.append(tuple(range(at, at + len(trial.sets))))
            at += len(trial.sets)
        return found

    @cached_property
    def candidates(self) -> list[Screened]:
        """The best trial of each effect in each grouping, the largest gain first."""
        found: dict[tuple[str, str], Screened] = {}
        for trial, columns in zip(self.trials, self.columns, strict=True):
            for by in self.study.groups:
                one = self._candidate(trial, columns, by)
                best = found.get((one.name, by))
                if best is None or (one.allowed, one.gain_nm2) > (best.allowed, best.gain_nm2):
                    found[one.name, by] = one
        return sorted(found.values(), key=lambda one: -one.gain_nm2)

    def cosine(self, a: Screened, b: Screened) -> float:
        """Alignment of what two candidates change, pooled over scans."""
        groups = self.study.groups
        inner = np.zeros((2, 2))
        for scan, gram in enumerate(self.freed):
            vectors = np.zeros((2, len(gram)))
            for row, one in zip(vectors, (a, b), strict=True):
                row[list(one.columns)] = one.multiples[groups[one.by][scan]]
            inner += vectors @ gram @ vectors.T
        return float(inner[0, 1] / max(np.sqrt(inner[0, 0] * inner[1, 1]), 1e-300))

    def permutation_p(self, one: Screened) -> float:
        """See ``permutation_p``."""
        labels = self.study.groups[one.by]
        return permutation_p(
            self.study, labels, one.gain_nm2, lambda by: self._gains(one.trial, one.columns, by)[0]
        )

    def family_p(self, one: Screened) -> float:
        """Share of flips of the signs of the scans whose largest gain of any candidate reaches this one's."""
        return float(np.mean(self._largest >= one.gains_nm2.sum() * (1 - 1e-9)))

    @cached_property
    def _largest(self) -> np.ndarray:
        """Largest sum of gains over the candidates of one strength, for each flip of the scans' signs."""
        gains = np.stack([one.gains_nm2 for one in self.candidates if one.by == ALL], axis=1)
        return (sign_flips(len(gains), self.study.seed) @ gains).max(axis=1)

    def _candidate(self, trial: Trial, columns: tuple[int, ...], by: str) -> Screened:
        gains, multiples = self._gains(trial, columns, self.study.groups[by])
        largest = max(max(trial.sizes(own).values()) for own in multiples.values())
        return Screened(
            trial=trial,
            by=by,
            gains_nm2=gains,
            multiples=multiples,
            columns=columns,
            allowed=all(trial.allowed(own, largest) for own in multiples.values()),
            retained=float(self._retained[list(columns)].max()),
            beside_base=float(self._beside_base[list(columns)].max()),
        )

    def _gains(
        self, trial: Trial, columns: tuple[int, ...], labels: Labels
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Held-out gains (scans,) nm², and the multiples by label from all scans."""
        return gains_by(
            self.freed, self.study.fold_of, columns, labels, lambda own: trial.allowed(own) * trial.reach(own)
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
