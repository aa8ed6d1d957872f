"""What each candidate would gain on held-out scans, from its derivative at the model so far.

A candidate is a set of columns: secants of an effect at some of its parameters, or maps along a covariate.
Its strength is one for all scans or one by group. Of each scan only inner products are needed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import Effect, get_effect
from litho_models.fitting.least_squares import gram_inside, orthonormal
from litho_models.loop.fits import ALL_FREE, State, Study
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms.grouped import ALL, Block, Labels, Products
from litho_models.scoring.statistics import sign_flips

# Of a direction's information, what must survive the projections for a test to mean anything.
SMALLEST_RETAINED = 1e-5
PERMUTATIONS = 199
_Key = tuple[str, tuple[tuple[str, float], ...]]


@dataclass(frozen=True)
class Trial:
    """Parameter sets of one effect of one shape and size; their amplitudes are fitted together."""

    effect: Effect
    sets: tuple[Mapping[str, float], ...]

    @cached_property
    def _facts(self) -> np.ndarray:
        """Of each amplitude null, lowest and highest value, and distance of an ordinary one from the null."""
        facts = [self.effect.parameters[name] for name in self.effect.amplitudes]
        return np.array([(f.null, f.lower, f.upper, abs(f.typical - f.null) or 1.0) for f in facts]).T

    def steps(self, multiples: np.ndarray) -> np.ndarray:
        """How far these multiples of the sets take each amplitude (amplitudes,) from its null."""
        return multiples @ _steps(self.effect, self.sets)

    def sizes(self, multiples: np.ndarray) -> np.ndarray:
        """The same without signs, in those of ordinary values."""
        return np.abs(self.steps(multiples)) / self._facts[3]

    def allowed(self, multiples: np.ndarray, largest: float = 0.0) -> bool:
        """No amplitude on the wrong side of a null that bounds it, unless noise may have put it there.

        Noise is what is small beside the largest amplitude, or beside ``largest``, that of any group.
        """
        (null, lower, upper, _), steps = self._facts, self.steps(multiples)
        wrong = ((steps < 0) & (null <= lower)) | ((steps > 0) & (null >= upper))
        sizes = self.sizes(multiples)
        return not (sizes[wrong] > 0.3 * max(largest, sizes.max())).any()

    def reach(self, multiples: np.ndarray) -> float:
        """Share of the step that stays within the ranges: a straight line from the null overshoots."""
        (null, lower, upper, _), steps = self._facts, self.steps(multiples)
        room = np.where(steps > 0, upper, lower) - null
        beyond = (np.abs(room) < np.abs(steps)) & (room != 0)
        return float(np.min(room[beyond] / steps[beyond], initial=1.0))

    def start(self, multiples: np.ndarray) -> dict[str, float]:
        """Values from which a fit begins, no farther from the null than the largest trial."""
        null, lower, upper, _ = self._facts
        largest = np.abs(_steps(self.effect, self.effect.trials)).max(axis=0)
        steps = np.clip(self.steps(multiples * self.reach(multiples)), -largest, largest)
        values = np.clip(null + steps, lower, upper).tolist()
        amplitudes = dict(zip(self.effect.amplitudes, values, strict=True))
        return {**self.effect.off_values(), **self.sets[0], **amplitudes}


def _steps(effect: Effect, sets: Sequence[Mapping[str, float]]) -> np.ndarray:
    """How far each set takes each amplitude from its null, (sets, amplitudes)."""
    nulls = {name: effect.parameters[name].null for name in effect.amplitudes}
    return np.array([[one.get(name, null) - null for name, null in nulls.items()] for one in sets])


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
        """Values by label from which a fit begins."""
        return {label: self.trial.start(own) for label, own in self.multiples.items()}


def trials_of(effects: Sequence[Effect]) -> list[Trial]:
    """The trials of the effects by shape and size.

    A second trial of the same amplitudes at the same shape is another size: what an effect does when it is
    large need not be a multiple of what it does when it is small.
    """
    found: list[Trial] = []
    for effect in effects:
        sizes: Counter[object] = Counter()
        together: dict[object, list[Mapping[str, float]]] = {}
        for trial in effect.trials:
            shape = tuple(sorted((k, v) for k, v in trial.items() if k not in effect.amplitudes))
            alike = shape, frozenset(trial)
            together.setdefault((shape, sizes[alike]), []).append(trial)
            sizes[alike] += 1
        found += [Trial(effect, tuple(own)) for own in together.values()]
    return found


class Secants:
    """What trials change in the windows at a model; what is known of one is not computed again."""

    def __init__(self, twin: Twin, windows: Sequence[PreparedScan]):
        self._placed, self._windows = twin.placed(), windows
        self._known: dict[_Key, list[NDArray[np.float32]]] = {}

    def learn(self, trials: Sequence[Trial]) -> None:
        """Compute what is not known yet."""
        new = [key for key in _keys(trials) if key not in self._known]
        self._known |= {key: [] for key in new}
        for window in self._windows if new else ():
            base = self._placed.base_height(self._placed.exposed(window), window)
            here = self._placed.height(window, base_um=base)
            for name, values in new:
                effect = get_effect(name)
                known = base if effect.acts_on == "height" else None
                moved = self._placed.height(window, {name: effect.with_values(dict(values))}, known)
                self._known[name, values].append(window.at_sample(moved - here).astype(np.float32))

    def of(self, trials: Sequence[Trial], number: int) -> list[NDArray[np.float32]]:
        """Changes (n,), µm, in one window, a row for each set of each trial."""
        return [self._known[key][number] for key in _keys(trials)]

    def free_terms(self, number: int) -> np.ndarray:
        """Orthonormal basis (n, k) of what one window may add by itself."""
        window = self._windows[number]
        return orthonormal(window.terms_at_sample(self._placed.height(window), ALL_FREE).T)


def _keys(trials: Sequence[Trial]) -> list[_Key]:
    return [(trial.effect.name, tuple(values.items())) for trial in trials for values in trial.sets]


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
        self.trials = trials_of(effects)
        secants = secants or Secants(state.twin, study.windows)
        secants.learn(self.trials)
        own = len(state.twin.vector)
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
        ends = np.cumsum([1 + own, *(len(trial.sets) for trial in self.trials)]).tolist()
        self.columns = [tuple(range(*pair)) for pair in pairwise(ends)]

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
        one, other = self._change(a), self._change(b)
        inner = np.einsum("asi,sij,bsj->ab", [one, other], self.freed, [one, other], optimize=True)
        return float(inner[0, 1] / max(np.sqrt(inner[0, 0] * inner[1, 1]), 1e-300))

    def _change(self, one: Screened) -> np.ndarray:
        """Multiples of all columns, (scans, columns), in what a candidate changes."""
        found = np.zeros(self.freed.shape[:2])
        found[:, one.columns] = [one.multiples[label] for label in self.study.groups[one.by]]
        return found

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
        largest = max(trial.sizes(own).max() for own in multiples.values())
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
