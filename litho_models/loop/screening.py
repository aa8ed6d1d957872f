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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import Effect
from litho_models.effects.chain import Fields
from litho_models.fitting.least_squares import gram_inside
from litho_models.loop.fits import State
from litho_models.loop.judging import EXCHANGED_P, FAMILY_P, SMALLEST_SHARE
from litho_models.loop.model import Twin
from litho_models.loop.prepared import ALL_FREE, PreparedScan
from litho_models.scan_terms.grouped import ALL, Block, Labels, Products
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

    Each set gives one column of the regression. ``columns`` contains the numbers of these columns.
    """

    effect: Effect
    sets: tuple[Mapping[str, float], ...]
    columns: list[int] = field(default_factory=list)

    @cached_property
    def _facts(self) -> np.ndarray:
        """Return four numbers for each amplitude: its null value, its lowest value, its highest value, and
        its usual distance from the null value. The result has shape (4, amplitudes).
        """
        facts = [self.effect.parameters[name] for name in self.effect.amplitudes]
        return np.array([(f.null, f.lower, f.upper, abs(f.typical - f.null) or 1.0) for f in facts]).T

    def steps(self, multiples: np.ndarray) -> np.ndarray:
        """Return the signed distance (step) of each amplitude from its null value, after each parameter set
        has been multiplied by its factor in ``multiples``. ``multiples`` has shape (…, sets), and the result
        has shape (…, amplitudes).
        """
        return multiples @ _steps(self.effect, self.sets)

    def allowed(self, multiples: np.ndarray, axis: int | None = None) -> np.ndarray:
        """Return whether every amplitude lies on the allowed side of its null value after each parameter set
        has been multiplied by its factor in ``multiples``, of shape (…, sets). If ``axis`` is -1, there is
        one result per row of ``multiples``; otherwise, there is a single result for all rows.

        An amplitude on the wrong side is ignored as noise if it is small relative to the largest amplitude:
        the largest of its row if ``axis`` is -1, and otherwise the largest of all rows.
        """
        (null, lower, upper, usual), steps = self._facts, self.steps(multiples)
        wrong = ((steps < 0) & (null <= lower)) | ((steps > 0) & (null >= upper))
        sizes = np.abs(steps) / usual
        return ~(wrong & (sizes > 0.3 * sizes.max(axis=axis, keepdims=True))).any(axis=axis)

    def reach(self, multiples: np.ndarray) -> np.ndarray:
        """For each row of ``multiples``, return the largest factor, at most 1, by which the steps of all
        amplitudes can be multiplied so that the amplitudes stay within their ranges.

        The full steps may lead out of the ranges, because they are obtained by linear extrapolation.
        """
        (null, lower, upper, _), steps = self._facts, self.steps(multiples)
        room = np.where(steps > 0, upper, lower) - null
        beyond = (np.abs(room) < np.abs(steps)) & (room != 0)
        return np.divide(room, steps, out=np.ones_like(steps), where=beyond).min(axis=-1)

    def start(self, multiples: np.ndarray) -> dict[str, float]:
        """Return the parameter values from which a fit starts. No amplitude is farther from its null value
        than in the parameter sets that screening tries.
        """
        null, lower, upper, _ = self._facts
        largest = np.abs(_steps(self.effect, self.effect.trials)).max(axis=0)
        steps = np.clip(self.steps(multiples * self.reach(multiples)), -largest, largest)
        values = np.clip(null + steps, lower, upper).tolist()
        amplitudes = dict(zip(self.effect.amplitudes, values, strict=True))
        return self.effect.with_values({**self.sets[0], **amplitudes})


def _steps(effect: Effect, sets: Sequence[Mapping[str, float]]) -> np.ndarray:
    """Return the signed distance (step) of each amplitude from its null value in each parameter set. The
    result has shape (sets, amplitudes).
    """
    nulls = {name: effect.parameters[name].null for name in effect.amplitudes}
    return np.array([[one.get(name, null) - null for name, null in nulls.items()] for one in sets])


def trials_of(effects: Sequence[Effect], first: int = 0) -> list[Trial]:
    """Combine the parameter sets of the effects into trials. The columns are numbered from ``first``.

    The sets of a trial have the same values of the shape parameters. If the same amplitudes are tried at two
    sizes, the two sizes belong to different trials. The reason is that the change that a large effect makes
    need not be a multiple of the change that a small effect makes.
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
        for own in together.values():
            found.append(Trial(effect, tuple(own), list(range(first, first + len(own)))))
            first += len(own)
    return found


class Secants:
    """Compute the changes that trials make to the predictions of a given model in all windows, and cache
    these changes.

    Attributes:
        free_terms: for each window, an orthonormal basis of the free scan terms at its n sampled pixels, of
            shape (n, k).
    """

    def __init__(self, twin: Twin, windows: Sequence[PreparedScan]):
        self._twin, self._windows = twin, windows
        self._fields: list[Fields] = [{} for _ in windows]
        self._heights_um = [
            twin.height(one, known=known) for one, known in zip(windows, self._fields, strict=True)
        ]
        heights = zip(windows, self._heights_um, strict=True)
        self.free_terms = [one.free_basis(height, ALL_FREE) for one, height in heights]
        self._known: dict[tuple[object, ...], list[NDArray[np.float32]]] = {}

    def of(self, trials: Sequence[Trial]) -> list[list[NDArray[np.float32]]]:
        """Return for each window a list of the changes that the parameter sets of all trials make to its
        prediction. Each change is an array of shape (n,), µm.
        """
        rows = []
        for effect, values in ((trial.effect, own) for trial in trials for own in trial.sets):
            key = effect.name, *values.items()
            if key not in self._known:
                extra, changes = {effect.name: effect.with_values(values)}, []
                for window, known, here in zip(self._windows, self._fields, self._heights_um, strict=True):
                    moved = self._twin.height(window, extra, ChainMap({}, known))
                    changes.append(window.at_sample(moved - here).astype(np.float32))
                self._known[key] = changes
            rows.append(self._known[key])
        return [[row[at] for row in rows] for at in range(len(self._windows))]


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
        shapes = sum(facts.kind == "shape" for facts in self.trial.effect.parameters.values())
        return len(self.trial.sets) * len(self.multiples) + shapes

    def start(self) -> dict[str, dict[str, float]]:
        """Return the parameter values from which a fit starts, keyed by group label."""
        return {label: self.trial.start(own) for label, own in self.multiples.items()}


class Screening:
    """Screen candidate effects against the residual of a fitted model.

    Args:
        state: the fitted model.
        effects: the candidate effects, none of which is in the model.
        secants: changes that the candidates make to the predictions of a similar model. If they are given,
            they are used as approximations, and the changes of the predictions of the fitted model are not
            computed.
        beside_own: whether the changes that the model's own parameters can make are projected out of the
            columns of the candidates.
    """

    def __init__(
        self,
        state: State,
        effects: Sequence[Effect],
        secants: Secants | None = None,
        beside_own: bool = True,
    ):
        self.study, self._mse_nm2 = state.study, state.mse_nm2
        own = len(state.twin.vector)
        self.trials = trials_of(effects, 1 + own)
        secants = secants or Secants(state.twin, self.study.windows)
        parts = zip(state.held_out_um, state.linear, secants.of(self.trials), secants.free_terms, strict=True)
        grams, raw = [], np.array(1e-300)
        for left, part, rows, free in parts:
            stacked = np.column_stack([left, *part.jacobian, *rows])
            whole = stacked.T @ stacked / len(stacked)
            grams.append(whole - gram_inside(stacked, free) / len(stacked))
            raw = raw + np.diag(whole)
        products = Products(np.stack(grams), self.study.groups)
        self.freed = products.freed_of([Block((1 + i,)) for i in range(own) if beside_own]).grams
        self._beside_base, self._retained = (
            np.einsum("sii->i", one) / raw for one in (products.grams, self.freed)
        )

    @cached_property
    def candidates(self) -> dict[str, dict[str, Screened]]:
        """Return the best trial of each effect for each grouping. The result is keyed by the name of the
        effect and then by the name of the grouping.
        """
        found: dict[str, dict[str, Screened]] = {}
        for trial in self.trials:
            own = found.setdefault(trial.effect.name, {})
            for by, labels in self.study.groups.items():
                multiples = self.strengths(labels, trial.columns)
                one = Screened(
                    trial=trial,
                    by=by,
                    gains_nm2=self.gains_by([labels], trial.columns, trial)[0],
                    multiples=multiples,
                    allowed=bool(trial.allowed(np.stack([*multiples.values()]))),
                    retained=float(self._retained[trial.columns].max()),
                    beside_base=float(self._beside_base[trial.columns].max()),
                )
                best = own.get(by)
                if best is None or (one.allowed, one.gain_nm2) > (best.allowed, best.gain_nm2):
                    own[by] = one
        common = np.array([own[ALL].gains_nm2 for own in found.values()]).T
        largest = (sign_flips(len(common), self.study.seed) @ common).max(axis=1) if found else common

        def judged(one: Screened) -> Screened:
            reached = largest >= one.gains_nm2.sum() * (1 - 1e-9)
            return replace(one, family_p=float(reached.mean()))

        return {name: {by: judged(one) for by, one in own.items()} for name, own in found.items()}

    @property
    def common(self) -> dict[str, Screened]:
        """Return the best trial of each effect for a strength that is the same in all scans, keyed by the
        name of the effect.
        """
        return {name: own[ALL] for name, own in self.candidates.items()}

    def standing(self) -> list[Screened]:
        """Return the significant candidates, in order of decreasing gain. Each candidate has its best
        grouping, or ``all`` if its strength does not differ significantly between groups.
        """
        standing = []
        for own in self.candidates.values():
            grouped = self._grouped(own)
            chosen = grouped or own[ALL]
            worth = chosen.gain_nm2 >= WORTH_FITTING * SMALLEST_SHARE * self._mse_nm2
            if not chosen.allowed or chosen.retained < SMALLEST_RETAINED or not worth:
                continue
            if grouped or chosen.family_p <= FAMILY_P:
                standing.append(chosen)
        return sorted(standing, key=lambda one: -one.gain_nm2)

    def _grouped(self, own: Mapping[str, Screened]) -> Screened | None:
        """Return the candidate with its best grouping of the scans. Return None if no grouping gives a
        significantly larger gain than a strength that is the same in all scans.
        """
        least = max(own[ALL].gain_nm2, 0.0) + SMALLEST_SHARE * self._mse_nm2
        options = {
            by: (one.gain_nm2, one.numbers)
            for by, one in own.items()
            if by != ALL and one.allowed and one.gain_nm2 > least
        }
        best = self.best_grouping(
            options, lambda by, moved: self.gains_by(moved, own[by].trial.columns, own[by].trial)
        )
        return replace(own[best[0]], group_p=best[1]) if best else None

    def cosine(self, a: Screened, b: Screened) -> float:
        """Return the cosine of the angle between the changes that two candidates make to the predictions. The
        changes in all scans form one vector per candidate.
        """
        # The change that a candidate makes is a weighted sum of columns. ``factors`` contains the weights of
        # the columns in each scan.
        factors = np.zeros((2, *self.freed.shape[:2]))
        for own, one in zip(factors, (a, b), strict=True):
            own[:, one.trial.columns] = [one.multiples[label] for label in self.study.groups[one.by]]
        inner = np.einsum("asi,sij,bsj->ab", factors, self.freed, factors, optimize=True)
        return float(inner[0, 1] / max(np.sqrt(inner[0, 0] * inner[1, 1]), 1e-300))

    def strengths(self, labels: Labels, columns: Sequence[int]) -> dict[str, np.ndarray]:
        """Fit the strengths of the columns to all scans of each group. Return them keyed by group label."""
        products, members = self._products(columns), np.array(labels)
        return {one: _solved(products[members == one].sum(axis=0)) for one in dict.fromkeys(labels)}

    def _products(self, columns: Sequence[int]) -> np.ndarray:
        both = np.array([0, *columns])
        return self.freed[:, both[:, None], both]

    def gains_by(
        self, groupings: Sequence[Labels] | np.ndarray, columns: Sequence[int], trial: Trial | None = None
    ) -> np.ndarray:
        """Return the gain of the given columns on each scan, nm², of shape (groupings, scans). The strengths
        of the columns differ by label, and they are fitted without the fold of the scan.

        Args:
            groupings: one or more groupings, each with the label of each scan.
            columns: numbers of the columns in the inner products.
            trial: trial with these columns. If it is given, strengths are reduced so that its amplitudes stay
                within their ranges. If a strength is not allowed, its gain is 0.
        """
        products, labels, fold_of = self._products(columns), np.array(groupings), self.study.fold_of
        # The strengths for a scan are fitted to the scans with the same label in other folds. If there are no
        # such scans, the scan gains nothing.
        fitted_to = _beside(labels) & ~_beside(fold_of)
        found = _solved(np.tensordot(fitted_to, products, 1))
        if trial:
            found *= (trial.allowed(found, -1) * trial.reach(found))[..., None]
        gains = found * (2 * products[:, 0, 1:] - np.einsum("sij,gsj->gsi", products[:, 1:, 1:], found))
        return gains.sum(axis=-1) * NM_PER_UM**2

    def best_grouping(
        self, options: Mapping[str, tuple[float, int]], gains_of: Callable[[str, np.ndarray], np.ndarray]
    ) -> tuple[str, float] | None:
        """Choose the grouping of the scans for a candidate whose strengths differ between groups. Only
        groupings with nearly the largest gain are considered. Of these, the grouping with the fewest
        parameters is chosen.

        Args:
            options: gain in nm² and number of parameters of each grouping, keyed by the name of the grouping.
            gains_of: function ``gains_of(by, moved)`` that returns gains for the permutation test, nm², of
                shape (groupings, scans). In each row, the strengths of the candidate that was found for the
                grouping ``by`` differ by one of the permuted groupings ``moved`` instead.

        Returns:
            The name of the chosen grouping, and its p value. The p value is the fraction of random
            permutations of the scans in which the gain with at least one grouping reaches the gain with the
            chosen grouping. Permutations that reproduce the chosen grouping are not counted. The result is
            None if no grouping has a gain, or if the gain of the chosen grouping is not significant.
        """
        most = max((gain for gain, _ in options.values()), default=0.0)
        close = {by: (numbers, -gain) for by, (gain, numbers) in options.items() if gain >= 0.95 * most > 0}
        if not close:
            return None
        best = min(close, key=lambda by: close[by])
        groupings = np.array([labels for by, labels in self.study.groups.items() if by != ALL])
        rng, judged = np.random.default_rng(self.study.seed), _beside(np.array(self.study.groups[best]))
        exchanged = beaten = 1
        for _ in range(PERMUTATIONS):
            moved = groupings[:, rng.permutation(len(self.study.scans))]
            if not (_beside(moved) == judged).all(axis=(1, 2)).any():
                exchanged += 1
                gained = gains_of(best, moved).mean(axis=1).max()
                beaten += int(gained >= options[best][0] * (1 - 1e-12))
                if beaten > EXCHANGED_P * (1 + PERMUTATIONS):
                    return None
        p = beaten / exchanged
        return (best, p) if p <= EXCHANGED_P else None


def _beside(labels: np.ndarray) -> np.ndarray:
    """Return a mask of the pairs of scans that share a label, of shape (…, scans, scans)."""
    return labels[..., :, None] == labels[..., None, :]


def _solved(products: np.ndarray) -> np.ndarray:
    inverse = np.linalg.pinv(products[..., 1:, 1:], rcond=1e-8, hermitian=True)
    return (inverse @ products[..., 1:, :1])[..., 0]
