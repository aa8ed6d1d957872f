"""Decide whether held-out scans confirm a change of the model. Each scan counts as one observation.

There must be at least ``FEWEST_SCANS`` scans, and three conditions must hold. First, the change must have the
right sign in most scans. In a scan that contains the effect, the inner product of the change of the
prediction with the residual before the change is positive. A sign-flip test of these products checks this
condition. Second, the change must reduce the squared error although its strength is the same in all scans (or
in all scans of a group): the confidence interval of the reduction must lie above zero. Third, the reduction
must be large enough to matter (see ``SMALLEST_SHARE``).
"""

from dataclasses import dataclass

import numpy as np

from litho_data.foundation import NM_PER_UM, Array
from litho_models.loop.fits import State, Study
from litho_models.scan_terms.grouped import ALL
from litho_models.scoring.statistics import bootstrap_interval, one_sided_flip_p

FAMILY_P = 0.05
# Largest accepted p value of a grouping of the scans. The limit is small because every candidate effect is
# tried with every grouping.
EXCHANGED_P = 0.01
# Largest accepted p value of the sign-flip test. Seven scans all have the right sign by chance with a
# probability of 1/128, which is above this limit, so at least eight scans are needed.
CONFIRM_P = 0.005
FEWEST_SCANS = 8
# Largest accepted p value of the sign-flip test if the strength differs by group. This limit is looser,
# because up to half of the scans may gain nothing, and because such a strength has already passed the test
# with permuted labels.
GROUPED_P = 0.05
# Smallest fraction of the squared error that counts. Compared with a common strength, strengths that differ
# by group must reduce the squared error further by at least this fraction. Any change of the model must
# reduce the squared error by at least twice this fraction (1 % of the rms error), because every formula is
# slightly wrong.
SMALLEST_SHARE = 0.01


@dataclass(frozen=True)
class Judgement:
    """The evidence for a change of the model. The gain is the reduction of the squared error on held-out
    scans.

    Attributes:
        before_nm2: mean squared error before the change.
        gain_nm2: mean decrease of the squared error.
        gains_nm2: decrease of the squared error of each scan, of shape (scans,).
        p: one-sided p value of the sign-flip test over the scans.
        low_nm2: lower end of the confidence interval of the mean gain.
    """

    before_nm2: float
    gain_nm2: float
    gains_nm2: Array
    p: float
    low_nm2: float

    @property
    def improved(self) -> tuple[int, int]:
        """Return two numbers: how many scans have a smaller error after the change, and how many scans there
        are.
        """
        return int((self.gains_nm2 > 0).sum()), len(self.gains_nm2)

    def reason(self, by: str = ALL) -> str:
        """Return the reason why the held-out scans do not confirm the change. The text is empty if they
        confirm it.

        ``by`` is ``all`` if the strength is the same in all scans, and otherwise the name of the grouping
        with one strength per group.
        """
        better, count = self.improved
        if count < FEWEST_SCANS:
            return f"{count} scans are too few: at least {FEWEST_SCANS} are needed to confirm anything"
        if self.p > (CONFIRM_P if by == ALL else GROUPED_P):
            return f"only {better} of {count} held-out scans improve (p = {self.p:.3f})"
        if self.low_nm2 <= 0:
            return "the confidence interval of the gain on held-out scans includes zero"
        if self.gain_nm2 < 2 * SMALLEST_SHARE * self.before_nm2:
            return f"the gain of {100 * self.gain_nm2 / self.before_nm2:.2f} % is too small to matter"
        return ""


def judge(before_nm2: Array, after_nm2: Array, study: Study, evidence_nm2: Array | None = None) -> Judgement:
    """Judge a change of the model on held-out scans.

    Args:
        before_nm2, after_nm2: mean squared error of each scan before and after the change, of shape (scans,).
        study: the study, which provides the seed.
        evidence_nm2: one number per scan for the sign-flip test, as returned by the function
            ``evidence_nm2``, of shape (scans,). By default, the decreases of the squared error are used.
    """
    gains = before_nm2 - after_nm2
    low, _ = bootstrap_interval(gains.tolist(), seed=study.seed)
    p = one_sided_flip_p(gains if evidence_nm2 is None else evidence_nm2)
    return Judgement(float(before_nm2.mean()), float(gains.mean()), gains, p, low)


def judge_states(before: State, after: State) -> Judgement:
    """Judge the change from one fitted model to another."""
    evidence = map(evidence_nm2, before.freed_um, after.freed_um)
    return judge(before.freed_nm2, after.freed_nm2, after.study, np.array([*evidence]))


def evidence_nm2(before_um: Array, after_um: Array) -> float:
    """Multiply the change of a prediction by the residual before this change, pixel by pixel. Return the mean
    of the product, nm². Pixels that were not measured are ignored.

    Args:
        before_um, after_um: residual before and after the change, µm.
    """
    return NM_PER_UM**2 * float(np.nanmean(before_um * (before_um - after_um)))


def told_apart(before: State, best: State, other: State) -> bool:
    """Return whether another change of the model is clearly worse than the best change. Two conditions must
    hold: a sign-flip test over the scans shows that the other change is worse, and the gain of the other
    change is at most three quarters of the best gain.

    Args:
        before: the model before the change.
        best, other: the model after the best change, and the model after the other change.
    """
    lost = judge(other.freed_nm2, best.freed_nm2, before.study)
    return lost.p <= CONFIRM_P and lost.gain_nm2 >= 0.25 * (before.mse_nm2 - best.mse_nm2)
