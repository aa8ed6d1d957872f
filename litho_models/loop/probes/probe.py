"""What a probe is: a generic term along one covariate, estimated and judged without a name for its cause."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms import Terms


@dataclass(frozen=True)
class Estimate:
    """Parameters on all scans, without each fold, and the gain in squared error on each held-out scan.

    ``common``: (m,); ``per_fold``: (folds, m); ``gains_nm2``: (scans,).
    """

    common: np.ndarray
    per_fold: np.ndarray
    gains_nm2: np.ndarray

    @property
    def mean_gain_nm2(self) -> float:
        return float(self.gains_nm2.mean())


def with_intervals(probe: Probe, estimate: Estimate) -> dict[str, tuple[float, str, tuple[float, float]]]:
    """The probe's numbers, name to (value, unit, 95 % interval from the jackknife over folds)."""
    from scipy.stats import t

    folds = [probe.summary(one) for one in estimate.per_fold]
    count = len(folds)
    reach = float(t.ppf(0.975, max(count - 1, 1)))
    found = {}
    for name, (value, unit) in probe.summary(estimate.common).items():
        values = np.array([fold[name][0] for fold in folds])
        half = reach * float(np.sqrt((count - 1) / count * ((values - values.mean()) ** 2).sum()))
        found[name] = (value, unit, (value - half, value + half))
    return found


def sums_by_fold(part: np.ndarray, fold_of: np.ndarray, axis: int = 0) -> np.ndarray:
    """Sums over the scans of each fold, (folds, …); ``axis``: that of the scans."""
    folds = range(int(fold_of.max()) + 1)
    return np.stack([part.compress(fold_of == fold, axis).sum(axis) for fold in folds], axis)


class Probe(Protocol):
    """One generic term; it says where a residual lives, not why."""

    @property
    def name(self) -> str:
        """Identifier in the result."""

    @property
    def free(self) -> Terms:
        """What every scan may add by itself in the estimate: of these the probe knows nothing."""

    def held_out(self, fold_of: np.ndarray) -> Estimate:
        """Fit without each fold; ``fold_of``: (scans,)."""

    def controls(self, fold_of: np.ndarray, random: np.random.Generator, count: int) -> np.ndarray:
        """Mean held-out gains (count,), nm², of the same fit where there can be nothing to find."""

    def agreement(self) -> float:
        """Correlation of what two disjoint halves of the scans ask for."""

    def summary(self, parameters: np.ndarray) -> dict[str, tuple[float, str]]:
        """Numbers for people: name to (value, unit)."""

    def correction(self, parameters: np.ndarray, scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        """Height to add (y, x), µm, to a prediction (y, x), µm."""

    def at_samples(self, parameters: np.ndarray, scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        """The same for several parameters (p, m), at the sampled pixels of the scan, (p, n) µm."""
        return np.stack([scan.at_sample(self.correction(one, scan, prediction)) for one in parameters])
