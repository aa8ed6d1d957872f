"""Predict, without a fit, how much each candidate effect would reduce the squared error on held-out scans.
This reduction is the gain of the effect.

Several parameter sets are tried for an effect. Each set gives one regressor (column): the change (secant)
that the effect with these parameters makes to the predictions of the current model. The gain is predicted by
a linear regression of the residual on the columns of the effect. The regression coefficients, i.e. the
strengths of the effect, are either the same in all scans or differ by group. The computation needs only the
inner products of the residual and the columns of each scan.
"""

from collections import ChainMap, Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import count

import numpy as np

from litho_data.foundation import NM_PER_UM, Array
from litho_models.effects import Effect
from litho_models.effects.chain import Fields
from litho_models.fitting.least_squares import gram
from litho_models.loop.fits import State
from litho_models.loop.joint_fit import SMALLEST_RETAINED, JointFit
from litho_models.loop.judging import EXCHANGED_P, FAMILY_P, SMALLEST_SHARE
from litho_models.loop.model import Twin, Values
from litho_models.loop.prepared import ALL_FREE, PreparedScan
from litho_models.scan_terms.grouped import ALL
from litho_models.scoring.statistics import sign_flips

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
    """

    effect: Effect
    sets: tuple[Mapping[str, float], ...]
    columns: list[int]

    @cached_property
    def _facts(self) -> Array:
        """Return four numbers for each amplitude: its null value, its lowest value, its highest value, and
        its usual distance from the null value. The result has shape (4, amplitudes).
        """
        facts = [self.effect.parameters[name] for name in self.effect.amplitudes]
        return np.array([(f.null, f.lower, f.upper, abs(f.typical - f.null) or 1.0) for f in facts]).T

    def _distances(self, sets: Sequence[Mapping[str, float]]) -> Array:
        """Return the signed distance (step) of each amplitude from its null value in each parameter set. The
        result has shape (sets, amplitudes).
        """
        values = [self.effect.with_values(one) for one in sets]
        return np.array([[own[name] for name in self.effect.amplitudes] for own in values]) - self._facts[0]

    def steps(self, multiples: Array) -> Array:
        """Return the signed distance (step) of each amplitude from its null value, after each parameter set
        has been multiplied by its factor in ``multiples``. ``multiples`` has shape (…, sets), and the result
        has shape (…, amplitudes).
        """
        return multiples @ self._distances(self.sets)

    def _room(self, steps: Array) -> Array:
        """Return the largest allowed step of each amplitude in the direction of the given step. It is zero if
        this direction leads to the wrong side of the null value.
        """
        null, lower, upper, _ = self._facts
        return np.where(steps > 0, upper, lower) - null

    def allowed(self, multiples: Array) -> Array:
        """Return for each row of ``multiples``, of shape (…, sets), whether every amplitude lies on the
        allowed side of its null value after each parameter set has been multiplied by its factor.

        An amplitude on the wrong side is ignored as noise if it is small relative to the largest amplitude of
        its row.
        """
        steps = self.steps(multiples)
        sizes = np.abs(steps) / self._facts[3]
        large = sizes > 0.3 * sizes.max(axis=-1, keepdims=True)
        return ~(large & (self._room(steps) == 0)).any(axis=-1)

    def strengths(self, fit: JointFit) -> Array:
        """Return the strengths of the joint fit, of shape (…, groups, sets). If the strengths of a group are
        not allowed, the effect is absent from this group: its strengths are 0, and all others are fitted
        again.
        """
        found = fit.strengths()
        while not (present := self.allowed(found)).all():
            fit = fit.only(present)
            found = fit.strengths()
        return found

    def reach(self, multiples: Array) -> Array:
        """For each row of ``multiples``, return the largest factor, at most 1, by which the steps of all
        amplitudes can be multiplied so that the amplitudes stay within their ranges.

        The full steps may lead out of the ranges, because they are obtained by linear extrapolation.
        """
        steps = self.steps(multiples)
        room = self._room(steps)
        return np.divide(room, steps, out=np.ones_like(steps), where=room * steps > 0).min(axis=-1, initial=1)

    def start(self, multiples: Array) -> dict[str, float]:
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
        # How often the same amplitudes have been tried with the same shape.
        sizes: Counter[object] = Counter()
        together: defaultdict[object, list[Mapping[str, float]]] = defaultdict(list)
        for trial in effect.trials:
            shape = frozenset((k, v) for k, v in trial.items() if k not in effect.amplitudes)
            alike = shape, frozenset(trial)
            together[shape, sizes[alike]].append(trial)
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
        def change_um(name: str, values: tuple[tuple[str, float], ...]) -> Array:
            moved = twin.height(window, {name: dict(values)}, ChainMap({}, fields))
            return window.at_sample(moved - height_um).astype(np.float32)

        self._change_um = change_um

    def of(self, trials: Sequence[Trial]) -> list[Array]:
        """Return the changes that the parameter sets of all trials make to the prediction. Each change is a
        float32 array of shape (n,), µm.
        """
        return [
            self._change_um(trial.effect.name, tuple(own.items())) for trial in trials for own in trial.sets
        ]


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
        allowed: whether the fitted amplitudes of at least one group lie on physically possible sides of their
            null values.
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
    gains_nm2: Array
    multiples: Mapping[str, Array]
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

    def start(self) -> Values:
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
        self._own = len(state.twin.vector)
        self.trials = trials_of(effects, 1 + self._own)
        secants = secants or [Secants(state.twin, window) for window in self.study.windows]
        grams, raw = [], []
        for left, part, changes in zip(state.held_out_um, state.linear, secants, strict=True):
            stacked = np.column_stack([left, *part.jacobian, *changes.of(self.trials)])
            grams.append(gram(stacked, changes.free_terms) / len(stacked))
            raw.append(np.square(stacked).mean(axis=0))
        self._grams, self._raw = np.stack(grams), np.stack(raw)
        # The number of each scan's group in each grouping, of shape (groupings, scans).
        self._numbers = np.array(
            [np.unique(labels, return_inverse=True)[1] for labels in self.study.groups.values()]
        )

    @cached_property
    def candidates(self) -> list[Screened]:
        """Return the best trial of each effect for each grouping."""
        best: dict[tuple[str, str], Screened] = {}
        for one in (own for trial in self.trials for own in self.screened(trial)):
            key = one.name, one.by
            best[key] = max(best.get(key, one), one, key=lambda own: (own.allowed, own.gain_nm2))
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

    def screened(self, trial: Trial) -> list[Screened]:
        """Screen one trial with each grouping of the scans. The p values are not computed."""
        members = _members(self._numbers)
        fit = _joint_fit(self._products(trial), trial, members)
        strengths, gains_nm2 = trial.strengths(fit), self._gains(self._numbers, trial)
        raw = np.maximum(members @ self._raw[:, trial.columns], 1e-300)
        alone, beside = (
            (np.einsum("...ii->...i", own) / raw).max(axis=(1, 2)).tolist()
            for own in (fit.of_columns, fit.beside_parameters())
        )
        return [
            Screened(
                trial=trial,
                by=by,
                gains_nm2=gains_nm2[at],
                # A grouping with fewer groups than another has strengths of 0 for the groups that it lacks.
                multiples=dict(zip(sorted(set(labels)), strengths[at], strict=False)),
                allowed=bool(strengths[at].any()),
                retained=beside[at],
                beside_base=alone[at],
            )
            for at, (by, labels) in enumerate(self.study.groups.items())
        ]

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
        changes in all scans form one vector per candidate. What the model's own parameters can imitate is
        projected out.
        """
        # Both changes are weighted sums of columns. ``mixed`` contains the weights of all columns in each
        # scan, first those of the residual and of the model's own parameters, and then those of the two
        # changes.
        mixed = np.zeros((*self._raw.shape, self._own + 3))
        mixed[:, : self._own + 1, :-2] = np.eye(self._own + 1)
        for at, one in ((-2, a), (-1, b)):
            mixed[:, one.trial.columns, at] = [one.multiples[label] for label in self.study.groups[one.by]]
        summed = np.einsum("smi,smn,snj->ij", mixed, self._grams, mixed, optimize=True)
        (inner,) = JointFit(summed[None], self._own).beside_parameters()
        return float(inner[0, 1] / max(np.sqrt(inner[0, 0] * inner[1, 1]), 1e-300))

    def _products(self, trial: Trial) -> Array:
        """Return the inner products of the residual, the model's own parameters and the columns of a trial in
        each scan.
        """
        at = np.r_[: 1 + self._own, trial.columns]
        return self._grams[:, at[:, None], at]

    def _gains(self, groupings: Array, trial: Trial) -> Array:
        """Return the gain of a trial on each scan, nm², of shape (groupings, scans). The strengths of its
        columns differ by group. They are fitted together with the model's own parameters, without the fold of
        the scan, and reduced so that the amplitudes stay within their ranges.

        Args:
            groupings: the number of each scan's group in one or more groupings, of shape (groupings, scans).
            trial: the trial.
        """
        products, fold_of = self._products(trial), self.study.fold_of
        fit = _joint_fit(products, trial, _members(groupings)[:, None] & ~_members(fold_of)[:, None])
        found = trial.strengths(fit)
        found *= trial.reach(found)[..., None]
        at = np.arange(len(groupings))[:, None], fold_of, groupings
        before, after = (
            np.einsum("gsi,sij,gsj->gs", rest, products, rest, optimize=True)
            for rest in (fit.rest(0 * found)[at], fit.rest(found)[at])
        )
        return (before - after) * NM_PER_UM**2

    def best_grouping(self, options: Sequence[Screened]) -> Screened | None:
        """Choose the grouping of the scans for a candidate whose strengths differ between groups. Only
        groupings with nearly the largest gain are considered. Of these, the grouping with the fewest
        parameters is chosen.

        Args:
            options: the candidate with each of the groupings.

        Returns:
            The candidate with the chosen grouping and the p value of this grouping. The p value is the
            fraction of random permutations of the scans in which the gain with at least one grouping reaches
            the gain with the chosen grouping. Permutations that reproduce the chosen grouping, or divide its
            groups further, are not counted. The result is None if no grouping has a gain, or if the gain of
            the chosen grouping is not significant.
        """
        most = max((one.gain_nm2 for one in options), default=0.0)
        close = [one for one in options if one.gain_nm2 >= 0.95 * most > 0]
        if not close:
            return None
        best = min(close, key=lambda one: (one.numbers, -one.gain_nm2))
        # The first grouping is ``all``.
        groupings = self._numbers[1:]
        judged = _alike(self._numbers[[*self.study.groups].index(best.by)])
        rng = np.random.default_rng(self.study.seed)
        exchanged = beaten = 1
        for _ in range(PERMUTATIONS):
            moved = groupings[:, rng.permutation(len(self.study.scans))]
            if not (_alike(moved) <= judged).all(axis=(1, 2)).any():
                exchanged += 1
                gained = self._gains(moved, best.trial).mean(axis=1).max()
                beaten += int(gained >= best.gain_nm2 * (1 - 1e-12))
                if beaten > EXCHANGED_P * (1 + PERMUTATIONS):
                    return None
        p = beaten / exchanged
        return replace(best, group_p=p) if p <= EXCHANGED_P else None


def _alike(numbers: Array) -> Array:
    """Return the mask of the pairs of scans in the same group, of shape (…, scans, scans)."""
    return numbers[..., :, None] == numbers[..., None, :]


def _joint_fit(products: Array, trial: Trial, members: Array) -> JointFit:
    """Return the joint fit of a trial and the model's own parameters to groups of scans.

    Args:
        products: inner products in each scan, as returned by ``Screening._products``.
        trial: the trial.
        members: mask of the scans in each group, of shape (…, groups, scans).
    """
    return JointFit(np.tensordot(members, products, 1), products.shape[-1] - 1 - len(trial.columns))


def _members(numbers: Array) -> Array:
    """Return the mask of the scans in each group, of shape (…, groups, scans)."""
    return numbers[..., None, :] == np.arange(numbers.max() + 1)[:, None]
