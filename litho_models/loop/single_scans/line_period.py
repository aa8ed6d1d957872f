"""Whether the offsets of lines repeat: a peak in their spectrum that all scans share, such as mains hum."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_data.roughness import LinePeriod, line_period
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms import LineIndex, freed_um

LARGEST_P = 1e-3


def period_of_lines(
    scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray], lines: Sequence[LineIndex]
) -> LinePeriod | None:
    """The strongest period that the line means of the residuals have in common, if it is no chance.

    Args:
        scans, predictions: scans and held-out predictions (y, x) µm.
        lines: the line of each pixel (y, x), one map per scan.
    """
    means = [_line_means(*one) for one in zip(scans, predictions, lines, strict=True)]
    found = line_period(means, scans[0].stored.pitch_um)
    return found if found is not None and found.p <= LARGEST_P else None


def _line_means(scan: PreparedScan, prediction: np.ndarray, line: LineIndex) -> np.ndarray:
    """Mean residual of each line, datum and bow of the scan taken out, µm."""
    use = scan.usable
    residual = freed_um(scan.stored.height_um, prediction, use, frozenset({"offset", "bow"}))
    count, total = np.bincount(line[use]), np.bincount(line[use], residual[use])
    return total / np.maximum(count, 1)
