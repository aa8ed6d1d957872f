"""Predict, without a fit, how much each candidate effect would reduce the squared error on held-out scans.
This reduction is the gain of the effect.

Several parameter sets are tried for an effect. Each set gives one regressor (column): the change (secant)
that the effect with these parameters makes to the predictions of the current model. The gain is predicted by
a linear regression of the residual on the columns of the effect. The regression coefficients, i.e. the
strengths of the effect, are either the same in all scans or differ by group. The computation needs only the
inner products of the residual and the columns of each scan.
"""

from __future__ import annotations

from collections import ChainMap, Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import count

import numpy as np
from numpy.typing import NDArray

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import Effect
from litho_models.effects.chain import Fields
from litho_models.fitting.least_squares import gram
from litho_models.loop.fits import State
from litho_models.loop.judging import EXCHANGED_P, FAMILY_P, SMALLEST_SHARE
from litho_models.loop.model import Twin
from litho_models.loop.prepared import ALL_FREE, PreparedScan
from litho_models.scan_terms.grouped import ALL, Block, Products
from litho_models.scoring.statistics import sign_flips

# The scan terms and the changes that the model's own parameters can make are projected out of each column. An
# effect can be tested only if at least this fraction of the squared norm of its column remains.
SMALLEST_RETAINED = 1e-5
# A candidate is fitted if its predicted gain reaches this fraction of the smallest gain that counts. The
# fraction is below 1 because screening predicts the gain of a fit only to within a factor of three.
WORTH_FITTING = 0.3
# Number of random permutations of the scans by which groupings are tested.
PERMUTATIONS = 199


@dataclass(frozen=True)
class Trial:
    """Parameter sets of one effect that are tried together. The sets have the same values of the shape
    parameters and differ only in which amplitudes are switched on. A regression fits one factor per set,
    which multiplies the change that the set makes.

    There is one column of the regression for each set. ``columns`` contains the numbers of the columns.

    A trial without sets stands for an effect that the model already contains. There is then one column for
    each amplitude: the derivative of the prediction with respect to this amplitude. The factor of a column is
    the change of the amplitude, and it is not limited.
    """

    effect: Effect
    sets: tuple[Mapping[str, float], ...]
    columns: list[int]

    @cached_property
    def _facts(self) -> np.ndarray:
        """Return four numbers for each amplitude: its null value, its lowest value, its highest value, and
        its usual distance from the null value. The result has shape (4, amplitudes).
        """
        facts = [self.effect.parameters[name] for name in self.effect.amplitudes]
        return np.array([(f.null, f.lower, f.upper, abs(f.typical - f.null) or 1.0) for f in facts]).T

    def _distances(self, sets: Sequence[Mapping[str, float]]) -> np.ndarray:
        """Return the signed distance (step) of each amplitude from its null value in each parameter set. The
        result has shape (sets, amplitudes).
        """
        nulls = {name: self.effect.parameters[name].null for name in self.effect.amplitudes}
        return np.array([[one.get(name, null) - null for name, null in nulls.items()] for one in sets])

    def steps(self, multiples: np.ndarray) -> np.ndarray:
        """Return the signed distance (step) of each amplitude from its null value, after each parameter set
        has been multiplied by its factor in ``multiples``. ``multiples`` has shape (…, sets), and the result
        has shape (…, amplitudes).
        """
        return multiples @ self._distances(self.sets)

    def _room(self, steps: np.ndarray) -> np.ndarray:
        """Return the largest allowed step of each amplitude in the direction of the given step. It is zero if
        this direction leads to the wrong side of the null value.
        """
        null, lower, upper, _ = self._facts
        return np.where(steps > 0, upper, lower) - null

    def allowed(self, multiples: np.ndarray, axis: int | None = None) -> np.ndarray:
        """Return whether every amplitude lies on the allowed side of its null value after each parameter set
        has been multiplied by its factor in ``multiples``, of shape (…, sets). If ``axis`` is -1, there is
        one result per row of ``multiples``; otherwise, there is a single result for all rows.

        An amplitude on the wrong side is ignored as noise if it is small relative to the largest amplitude:
        the largest of its row if ``axis`` is -1, and otherwise the largest of all rows.
        """
        steps = self.steps(multiples)
        sizes = np.abs(steps) / self._facts[3]
        large = sizes > 0.3 * sizes.max(axis=axis, keepdims=True)
        return ~(large & (self._room(steps) == 0)).any(axis=axis)

    def reach(self, multiples: np.ndarray) -> np.ndarray:
        """For each row of ``multiples``, return the largest factor, at most 1, by which the steps of all
        amplitudes can be multiplied so that the amplitudes stay within their ranges.

        The full steps may lead out of the ranges, because they are obtained by linear extrapolation.
        """
        steps = self.steps(multiples)
        room = self._room(steps)
        return np.divide(room, steps, out=np.ones_like(steps), where=room * steps > 0).min(axis=-1, initial=1)

    def start(self, multiples: np.ndarray) -> dict[str, float]:
        """Return the parameter values from which a fit starts. No amplitude is farther from its null value
        than in the parameter sets that screening tries.
        """
        null, lower, upper, _ = self._facts
        largest = np.abs(self._distances(self.effect.trials)).max(axis=0)
        steps = np.clip(self.steps(multiples * self.reach(multiples)), -largest, largest)
        values = np.clip(null + steps, lower, upper).tolist()
        amplitudes = dict(zip(self.effect.amplitudes, values, strict=True))
        return self.effect.with_values({**self.sets[0], **amplitudes})


def trials_of(effects: Sequence[Effect], first: int) -> list[Trial]:
    """Combine the parameter sets of the effects into trials. The columns are numbered from ``first``.

    The sets of a trial have the same values of the shape parameters. If the same amplitudes are tried at two
    sizes, the two sizes belong to different trials. The reason is that the change that a large effect makes
    need not be a multiple of the change that a small effect makes.
    """
    found: list[Trial] = []
    numbers = count(first)
    for effect in effects:
        sizes: Counter[object] = Counter()
        together: dict[object, list[Mapping[str, float]]] = {}
        for trial in effect.trials:
            shape = frozenset((k, v) for k, v in trial.items() if k not in effect.amplitudes)
            alike = shape, frozenset(trial)
            together.setdefault((shape, sizes[alike]), []).append(trial)
            sizes[alike] += 1
        found += [Trial(effect, tuple(own), [next(numbers) for _ in own]) for own in together.values()]
    return found


class Secants:
    """Compute the changes that trials make to the prediction of a given model in one window, and cache these
    changes.

    Attributes:
        free_terms: orthonormal basis of the free scan terms at the n sampled pixels, of shape (n, k).
    """

    def __init__(self, twin: Twin, window: PreparedScan):
        fields: Fields = {}
        height_um = twin.height(window, known=fields)
        self.free_terms = window.free_basis(height_um, ALL_FREE)

        @cache
        def change_um(name: str, values: tuple[tuple[str, float], ...]) -> NDArray[np.float32]:
            moved = twin.height(window, {name: dict(values)}, ChainMap({}, fields))
            return window.at_sample(moved - height_um).astype(np.float32)

        self._change_um = change_um

    def of(self, trials: Sequence[Trial]) -> list[NDArray[np.float32]]:
        """Return the changes that the parameter sets of all trials make to the prediction. Each change is an
        array of shape (n,), µm.
        """
        pairs = ((trial.effect.name, own) for trial in trials for own in trial.sets)
        return [self._change_um(name, tuple(own.items())) for name, own in pairs]


@dataclass(frozen=True, eq=False)
class Screened:
    """The result of screening a trial with one grouping of the scans. It contains the gain that is predicted
    for held-out scans, and tests of this gain.

    Attributes:
        trial: the parameter sets that were tried.
        by: ``all`` if the strength is the same in all scans, and otherwise the name of the grouping with one
            strength per group.
        gains_nm2: predicted decrease of the squared error of each scan, of shape (scans,). The strengths are
            fitted without the fold of this scan.
        multiples: the factors by which the parameter sets of the trial are multiplied, keyed by group label.
            They are fitted to all scans.
        allowed: whether the fitted amplitudes lie on physically possible sides of their null values.
        retained: fraction of a column's squared norm that remains after the scan terms and the changes that
            the model's own parameters can make have been projected out. If the trial has several columns,
            this is the largest of their fractions.
        beside_base: the same fraction after only the scan terms have been projected out.
        family_p: p value of the candidate. The signs of the scans' gains are flipped in many ways. The p
            value is the fraction of these ways in which at least one candidate reaches the gain of this
            candidate.
        group_p: p value of the grouping. The scans are permuted at random. The p value is the fraction of the
            permutations in which the gain with at least one grouping reaches the gain with this grouping.
            None if no grouping was tested.
    """

    trial: Trial
    by: str
    gains_nm2: np.ndarray
    multiples: Mapping[str, np.ndarray]
    allowed: bool
    retained: float
    beside_base: float
    family_p: float = 1.0
    group_p: float | None = None

    @property
    def name(self) -> str:
        return self.trial.effect.name

    @property
    def gain_nm2(self) -> float:
        return float(self.gains_nm2.mean())

    @property
    def numbers(self) -> int:
        return len(self.trial.columns) * len(self.multiples) + sum(
            facts.kind == "shape" for facts in self.trial.effect.parameters.values()
        )

    def start(self) -> dict[str, dict[str, float]]:
        """Return the parameter values from which a fit starts, keyed by group label."""
        return {label: self.trial.start(own) for label, own in self.multiples.items()}


class Screening:
    """Screen candidate effects against the residual of a fitted model.

    Args:
        state: the fitted model.
        effects: the candidate effects, none of which is in the model.
        secants: for each window, the changes that the candidates make to the prediction of a similar model.
            If they are given, they are used as approximations, and the changes of the predictions of the
            fitted model are not computed.
    """

    def __init__(
        self,
        state: State,
        effects: Sequence[Effect],
        secants: Sequence[Secants] | None = None,
    ):
        self.study, self._mse_nm2 = state.study, state.mse_nm2
        own = len(state.twin.vector)
        self.trials = trials_of(effects, 1 + own)
        secants = secants or [Secants(state.twin, window) for window in self.study.windows]
        grams, raw = [], np.array(1e-300)
        for left, part, changes in zip(state.held_out_um, state.linear, secants, strict=True):
            stacked = np.column_stack([left, *part.jacobian, *changes.of(self.trials)])
            grams.append(gram(stacked, changes.free_terms) / len(stacked))
            raw = raw + np.square(stacked).mean(axis=0)
        self._grams = np.stack(grams)
        blocks = [Block((1 + i,)) for i in range(own)]
        self._freed = Products(self._grams, self.study.groups).freed_of(blocks).grams
        self._beside_base, self._retained = (
            np.einsum("sii->i", one) / raw for one in (self._grams, self._freed)
        )

    @cached_property
    def candidates(self) -> list[Screened]:
        """Return the best trial of each effect for each grouping."""
        best: dict[tuple[str, str], Screened] = {}
        for one in (self.screened(trial, by) for trial in self.trials for by in self.study.groups):
            other = best.setdefault((one.name, one.by), one)
            if (one.allowed, one.gain_nm2) > (other.allowed, other.gain_nm2):
                best[one.name, one.by] = one
        found = best.values()
        common = np.array([one.gains_nm2 for one in found if one.by == ALL]).T
        largest = (sign_flips(len(common), self.study.seed) @ common).max(axis=1) if found else common
        return [
            replace(one, family_p=float(np.mean(largest >= one.gains_nm2.sum() * (1 - 1e-9))))
            for one in found
        ]

    @property
    def common(self) -> dict[str, Screened]:
        """Return the best trial of each effect for a strength that is the same in all scans, keyed by the
        name of the effect.
        """
        return {one.name: one for one in self.candidates if one.by == ALL}

    def screened(self, trial: Trial, by: str) -> Screened:
        """Screen one trial with one grouping of the scans, without the p values."""
        labels = np.array(self.study.groups[by])
        fitted = _solved(self._products(trial), _beside(labels))
        return Screened(
            trial=trial,
            by=by,
            gains_nm2=self._gains(labels[None], trial)[0],
            multiples=dict(zip(labels.tolist(), fitted, strict=True)),
            allowed=not trial.sets or bool(trial.allowed(fitted)),
            retained=float(self._retained[trial.columns].max()),
            beside_base=float(self._beside_base[trial.columns].max()),
        )

    def standing(self) -> list[Screened]:
        """Return the significant candidates, in order of decreasing gain. Each candidate has its best
        grouping, or ``all`` if its strength does not differ significantly between groups.
        """
        standing, least = [], SMALLEST_SHARE * self._mse_nm2
        for name, common in self.common.items():
            # Strengths that differ by group must gain more than one strength for all scans.
            needed = max(common.gain_nm2, 0.0) + least
            best = self.best_grouping(
                [one for one in self.candidates if one.name == name and one.allowed and one.gain_nm2 > needed]
            )
            one = best or common
            worth = one.gain_nm2 >= WORTH_FITTING * least and one.retained >= SMALLEST_RETAINED
            if one.allowed and worth and (best or one.family_p <= FAMILY_P):
                standing.append(one)
        return sorted(standing, key=lambda one: -one.gain_nm2)

    def cosine(self, a: Screened, b: Screened) -> float:
        """Return the cosine of the angle between the changes that two candidates make to the predictions. The
        changes in all scans form one vector per candidate.
        """
        # The change that a candidate makes is a weighted sum of columns. ``factors`` contains the weights of
        # the columns in each scan.
        factors = np.zeros((2, *self._freed.shape[:2]))
        for own, one in zip(factors, (a, b), strict=True):
            own[:, one.trial.columns] = [one.multiples[label] for label in self.study.groups[one.by]]
        inner = np.einsum("asi,sij,bsj->ab", factors, self._freed, factors, optimize=True)
        return float(inner[0, 1] / max(np.sqrt(inner[0, 0] * inner[1, 1]), 1e-300))

    def _products(self, trial: Trial) -> np.ndarray:
        both = np.array([0, *trial.columns])
        # The amplitudes of an effect in the model differ by group, and parameters that are the same in all
        # scans cannot explain such a difference. The changes that they can make are not projected out.
        return (self._freed if trial.sets else self._grams)[:, both[:, None], both]

    def _gains(self, groupings: np.ndarray, trial: Trial) -> np.ndarray:
        """Return the gain of a trial on each scan, nm², of shape (groupings, scans). The strengths of its
        columns differ by label, and they are fitted without the fold of the scan. They are reduced so that
        the amplitudes stay within their ranges. If a strength is not allowed, its gain is 0.

        Args:
            groupings: the label of each scan in one or more groupings, of shape (groupings, scans).
            trial: the trial.
        """
        products = self._products(trial)
        # The strengths for a scan are fitted to the scans with the same label in other folds. If there are no
        # such scans, the scan gains nothing.
        found = _solved(products, _beside(groupings) & ~_beside(self.study.fold_of))
        if trial.sets:
            found *= (trial.allowed(found, -1) * trial.reach(found))[..., None]
        gains = found * (2 * products[:, 0, 1:] - np.einsum("sij,gsj->gsi", products[:, 1:, 1:], found))
        return gains.sum(axis=-1) * NM_PER_UM**2

    def best_grouping(self, options: Sequence[Screened]) -> Screened | None:
        """Choose the grouping of the scans for a candidate whose strengths differ between groups. Only
        groupings with nearly the largest gain are considered. Of these, the grouping with the fewest
        parameters is chosen.

        Args:
            options: the candidate with each of the groupings.

        Returns:
            The candidate with the chosen grouping and the p value of this grouping. The p value is the
            fraction of random permutations of the scans in which the gain with at least one grouping reaches
            the gain with the chosen grouping. Permutations that reproduce the chosen grouping are not
            counted. The result is None if no grouping has a gain, or if the gain of the chosen grouping is
            not significant.
        """
        most = max((one.gain_nm2 for one in options), default=0.0)
        close = [one for one in options if one.gain_nm2 >= 0.95 * most > 0]
        if not close:
            return None
        best = min(close, key=lambda one: (one.numbers, -one.gain_nm2))
        # The first grouping is ``all``.
        groupings = np.array([*self.study.groups.values()][1:])
        rng, judged = np.random.default_rng(self.study.seed), _beside(np.array(self.study.groups[best.by]))
        exchanged = beaten = 1
        for _ in range(PERMUTATIONS):
            moved = groupings[:, rng.permutation(len(self.study.scans))]
            if not (_beside(moved) == judged).all(axis=(1, 2)).any():
                exchanged += 1
                gained = self._gains(moved, best.trial).mean(axis=1).max()
                beaten += int(gained >= best.gain_nm2 * (1 - 1e-12))
                if beaten > EXCHANGED_P * (1 + PERMUTATIONS):
                    return None
        p = beaten / exchanged
        return replace(best, group_p=p) if p <= EXCHANGED_P else None


def _beside(labels: np.ndarray) -> np.ndarray:
    """Return a mask of the pairs of scans that share a label, of shape (…, scans, scans)."""
    return labels[..., :, None] == labels[..., None, :]


def _solved(products: np.ndarray, fitted_to: np.ndarray) -> np.ndarray:
    """Fit strengths for each scan to other scans, and return them, of shape (…, scans, columns).

    Args:
        products: inner products of the residual and the columns in each scan, of shape (scans, 1 + columns, 1
            + columns).
        fitted_to: for each scan, the mask of the scans to which its strengths are fitted, of shape (…, scans,
            scans).
    """
    summed = np.tensordot(fitted_to, products, 1)
    inverse = np.linalg.pinv(summed[..., 1:, 1:], rcond=1e-8, hermitian=True)
    return (inverse @ summed[..., 1:, :1])[..., 0]
