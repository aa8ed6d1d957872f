"""One judge: is a change of the model confirmed on scans that it was not fitted on? Scans are the units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from litho_models.loop.fits import Study
from litho_models.scoring.statistics import bootstrap_interval, one_sided_flip_p

FAMILY_P = 0.05
# Every candidate and law is tried by every grouping: one in a hundred exchanges may do as well.
EXCHANGED_P = 0.01
# By chance alone seven gains out of seven come once in 128: below eight scans nothing is confirmed.
CONFIRM_P = 0.005
FEWEST_SCANS = 8
# A strength by group was held against exchanged labels already: half of the scans may have nothing to gain.
GROUPED_P = 0.05
# Of the squared error: what is worth a strength by group, or a search. A change of the model has to take
# twice that, one percent of the root: its form is always wrong by a little.
SMALLEST_SHARE = 0.01


@dataclass(frozen=True)
class Judgement:
    """Gain of a change on held-out scans.

    Attributes:
        before_nm2, gain_nm2: mean squared error before, and what the change takes from it.
        gains_nm2: (scans,) of each scan.
        p: one-sided, by flips of the signs of the scans' gains; ``low_nm2``: lower end of the interval.
    """

    before_nm2: float
    gain_nm2: float
    gains_nm2: np.ndarray
    p: float
    low_nm2: float

    @property
    def improved(self) -> tuple[int, int]:
        """Scans that are better, and all."""
        return int((self.gains_nm2 > 0).sum()), len(self.gains_nm2)

    @property
    def matters(self) -> bool:
        """Large enough to be of use."""
        return self.gain_nm2 >= 2 * SMALLEST_SHARE * self.before_nm2

    def passed(self, *, grouped: bool = False) -> bool:
        """Whether it is confirmed."""
        return not self.reason(grouped=grouped)

    def reason(self, *, grouped: bool = False) -> str:
        """Why it is not confirmed; empty if it is."""
        better, count = self.improved
        if count < FEWEST_SCANS:
            return f"{count} scans, at least {FEWEST_SCANS} are needed to confirm anything"
        if self.p > (GROUPED_P if grouped else CONFIRM_P):
            return f"better in only {better} of {count} held-out scans (p = {self.p:.3f})"
        if self.low_nm2 <= 0:
            return "the interval of the held-out gain includes zero"
        if not self.matters:
            return f"gain of {100 * self.gain_nm2 / self.before_nm2:.2f} % is too small to matter"
        return ""


def judge(before_nm2: np.ndarray, after_nm2: np.ndarray, study: Study) -> Judgement:
    """Judge a change by the squared error (scans,) before and after, nm²."""
    gains = before_nm2 - after_nm2
    low, _ = bootstrap_interval(gains.tolist(), seed=study.seed)
    return Judgement(float(before_nm2.mean()), float(gains.mean()), gains, one_sided_flip_p(gains), low)


def told_apart(before_nm2: np.ndarray, best_nm2: np.ndarray, other_nm2: np.ndarray, study: Study) -> bool:
    """Whether a rival is worse than the best in nearly every scan, by a quarter of the gain or more."""
    lost = judge(other_nm2, best_nm2, study)
    return lost.p <= CONFIRM_P and lost.gain_nm2 >= 0.25 * float((before_nm2 - best_nm2).mean())
