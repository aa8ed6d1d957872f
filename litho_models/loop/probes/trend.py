"""Do the scans' own offset and gain follow the order in which they were printed: a line, or one step?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.single_scans.nested_tests import scan_parameters
from litho_models.scoring.statistics import PERMUTATIONS

# Fewer scans than this on one side of a step fit anything.
_SHORTEST_SIDE = 3


@dataclass(frozen=True)
class OrderTrend:
    """One per-scan term against the place in the writing order.

    Attributes:
        term, unit: ``offset`` in nm or ``gain``.
        slope: from the first to the last scan; ``slope_p`` under permuted orders.
        step: largest jump; ``step_after``: scan before it; ``step_p``: the same control, over all places.
        left_out: root mean square error of (the mean, the line, the step) on prints left out.
    """

    term: str
    unit: str
    slope: float
    slope_p: float
    step: float
    step_after: str
    step_p: float
    left_out: tuple[float, float, float]


def order_trends(
    scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray], seed: int = 0
) -> list[OrderTrend]:
    """Test offset and gain of the scans; empty where the order is not known or the scans are few.

    Args:
        scans, predictions: scans and held-out predictions (y, x) µm.
        seed: of the permutations.
    """
    order = np.array([scan.context.order for scan in scans])
    if len(scans) < 2 * _SHORTEST_SIDE + 2 or len(np.unique(order)) < len(scans):
        return []
    rank = np.argsort(order)
    prints = [scans[i].stored.print_id for i in rank]
    values = scan_parameters(scans, predictions, frozenset({"offset", "gain"}))[rank]
    place = np.linspace(-0.5, 0.5, len(rank))
    names = [scans[i].id for i in rank]
    return [
        _trend(term, unit, values[:, column] * scale, place, names, prints, seed)
        for column, (term, unit, scale) in enumerate((("offset", "nm", NM_PER_UM), ("gain", "1", 1.0)))
    ]


def _trend(
    term: str,
    unit: str,
    values: np.ndarray,
    place: np.ndarray,
    names: list[str],
    prints: Sequence[str],
    seed: int,
) -> OrderTrend:
    random = np.random.default_rng(seed)
    slope, (gain, after, step) = _slope(values, place), _step(values)
    shuffled = [random.permutation(values) for _ in range(PERMUTATIONS)]
    slopes = np.array([_slope(other, place) for other in shuffled])
    gains = np.array([_step(other)[0] for other in shuffled])
    return OrderTrend(
        term=term,
        unit=unit,
        slope=slope,
        slope_p=float((1 + (np.abs(slopes) >= abs(slope)).sum()) / (PERMUTATIONS + 1)),
        step=step,
        step_after=names[after],
        step_p=float((1 + (gains >= gain).sum()) / (PERMUTATIONS + 1)),
        left_out=_left_out(values, place, np.asarray(prints)),
    )


def _slope(values: np.ndarray, place: np.ndarray) -> float:
    return float(place @ (values - values.mean()) / (place @ place))


def _step(values: np.ndarray) -> tuple[float, int, float]:
    """Explained squares, index before the jump and its size, for the best place of one step."""
    count = len(values)
    sums = np.cumsum(values - values.mean())
    before = np.arange(1, count + 1)
    allowed = (before >= _SHORTEST_SIDE) & (count - before >= _SHORTEST_SIDE)
    explained = np.where(allowed, sums**2 * count / (before * np.maximum(count - before, 1)), -1.0)
    best = int(np.argmax(explained))
    return float(explained[best]), best, float(values[best + 1 :].mean() - values[: best + 1].mean())


def _left_out(values: np.ndarray, place: np.ndarray, prints: np.ndarray) -> tuple[float, float, float]:
    """Errors on each print left out in turn, fitted on the others; each scan where prints are unknown."""
    groups = prints if len(set(prints)) > 2 else np.arange(len(values)).astype(str)
    errors = np.zeros((len(values), 3))
    for group in np.unique(groups):
        out = groups == group
        kept, there = values[~out], place[~out]
        centre = kept.mean()
        slope = (there - there.mean()) @ (kept - centre) / ((there - there.mean()) ** 2).sum()
        _, last, _ = _step(kept)
        low, high = kept[: last + 1].mean(), kept[last + 1 :].mean()
        edge = (there[last] + there[last + 1]) / 2
        errors[out, 0] = values[out] - centre
        errors[out, 1] = values[out] - centre - slope * (place[out] - there.mean())
        errors[out, 2] = values[out] - np.where(place[out] <= edge, low, high)
    mean, line, step = np.sqrt((errors**2).mean(axis=0))
    return float(mean), float(line), float(step)
