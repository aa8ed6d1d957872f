"""Whether the offsets of lines repeat: a peak in their spectrum that all scans share, such as mains hum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import gamma

from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms import LineIndex, fitted_terms

# Bonferroni over the frequencies; a peak is compared with the median of those around it.
LARGEST_P = 1e-3
_AROUND = 21
_FEWEST_LINES = 64


@dataclass(frozen=True)
class LinePeriod:
    """Lines repeat every ``period_um``; ``share`` of their squared offsets; ``p`` over all frequencies."""

    period_um: float
    share: float
    p: float


def line_period(
    scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray], lines: Sequence[LineIndex]
) -> LinePeriod | None:
    """The strongest period that the line means of the residuals have in common, if it is no chance.

    The mean periodogram of F scans over its local level is distributed as Gamma(F) / F.

    Args:
        scans, predictions: scans and held-out predictions (y, x) µm.
        lines: the line of each pixel (y, x), one map per scan.
    """
    means = [_line_means(*one) for one in zip(scans, predictions, lines, strict=True)]
    count = min(len(own) for own in means)
    if count < _FEWEST_LINES:
        return None
    taper = np.hanning(count)
    spectra = np.stack([np.abs(np.fft.rfft(taper * (m[:count] - m[:count].mean()))) ** 2 for m in means])
    # Scans differ in roughness: each counts by its own level. The slowest are what a bow leaves.
    spectra = (spectra / np.maximum(np.median(spectra, axis=1, keepdims=True), np.finfo(float).tiny))[:, 3:]
    power = spectra.mean(axis=0)
    expected = gamma.median(len(scans)) / len(scans)
    level = median_filter(power, _AROUND, mode="reflect") / expected
    peak = int(np.argmax(power / level))
    p = min(1.0, float(len(power) * gamma.sf(len(scans) * power[peak] / level[peak], len(scans))))
    if p > LARGEST_P:
        return None
    near = slice(max(0, peak - 2), peak + 3)
    centre = float(np.average(np.arange(len(power))[near] + 3, weights=power[near]))
    excess = np.maximum(power[near] - level[near], 0).sum()
    return LinePeriod(count * scans[0].stored.pitch_um / centre, float(excess / power.sum()), p)


def _line_means(scan: PreparedScan, prediction: np.ndarray, line: LineIndex) -> np.ndarray:
    """Mean residual of each line, datum and bow of the scan taken out, µm."""
    _, own = fitted_terms(scan.stored.height_um, prediction, scan.usable, frozenset({"offset", "bow"}))
    use = scan.usable
    count = np.bincount(line[use])
    total = np.bincount(line[use], (scan.stored.height_um - prediction - own)[use])
    return total / np.maximum(count, 1)
