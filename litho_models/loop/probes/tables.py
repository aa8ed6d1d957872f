"""Tables: one height correction per printed level, or per steepness of the predicted print."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.linear import ColumnsOf, Left, LinearProbe, linear_probe, second_differences

# The level that reaches a pixel is spread by the printer's spot.
SPOT_UM = 0.2
SLOPE_KNOTS = 8
_FEWEST_SCANS, _SMALLEST_SHARE = 5, 0.01
# Places in the order, which runs from -0.5 to 0.5, where something may jump.
ORDER_STEPS = (-0.25, 0.0, 0.25)
FEWEST_ORDERS = 3
_DRIFTING = ("h²", "|y|", "|x|")
_OVER_ORDER = ("over order", *(f"after {0.5 + step:.0%} of the order" for step in ORDER_STEPS))
# h: height, y and x: slopes along y and x.
_POWERS = (
    *("h²", "h³", "y²", "x²", "yx", "y³", "x³"),
    *("h y", "h x", "h |y|", "h |x|", "h² |y|", "h² |x|"),
)
Steepness = Callable[[PreparedScan, np.ndarray], np.ndarray]


def level_table(left: Left) -> LinearProbe | None:
    """One height correction per printed level; None where fewer than four levels can be estimated.

    Offset and slope over the levels belong to each scan's datum and gain and are projected out with them.
    Levels in fewer than 5 scans or 1 % of the pixels are left alone.
    """
    levels = estimated_levels(left.scans)
    if len(levels) < 4:
        return None
    entries = [f"level_{level}" for level in levels]
    columns_of = partial(_level_columns, levels=levels)
    return _table("level-table", entries, columns_of, left)


def estimated_levels(scans: Sequence[PreparedScan]) -> list[int]:
    """Levels that enough scans and pixels hold."""
    highest = max(int(scan.stored.levels) for scan in scans)
    counts = np.stack(
        [np.bincount(scan.stored.mask_level.ravel().astype(int), minlength=highest) for scan in scans]
    )
    shares = counts.sum(axis=0) / counts.sum()
    enough = (counts > 0).sum(axis=0) >= min(_FEWEST_SCANS, len(scans))
    return [int(level) for level in np.flatnonzero(enough & (shares >= _SMALLEST_SHARE))]


def slope_table(left: Left) -> LinearProbe:
    """One height correction per steepness of the predicted print, linear in between."""
    knots = _slope_knots(_steepness, left)
    entries = [f"slope_{knot:.2f}" for knot in knots]
    columns_of = partial(_slope_columns, steepness=_steepness, knots=knots)
    return _table("slope-table", entries, columns_of, left)


def directed_slope_table(
    left: Left,
    *,
    name: str,
    along: Sequence[str],
) -> LinearProbe:
    """One height correction per steepness along each of these directions, added.

    What a slope does along one direction and not along another no table over the steepness can follow.
    """
    knots = {one: _slope_knots(_ALONG[one], left) for one in along}
    entries = [f"along_{one}_{knot:.2f}" for one, places in knots.items() for knot in places]
    columns_of = partial(_directed_slope_columns, knots=knots)
    return _table(name, entries, columns_of, left, blocks=len(knots))


def shape_powers(left: Left) -> LinearProbe:
    """Powers and products of height and slopes of the predicted print; no table over one follows them."""
    penalty = np.eye(len(_POWERS))
    return _heights("shape-powers", _POWERS, _power_columns, penalty, left)


def order_shapes(left: Left) -> LinearProbe | None:
    """Height and slopes whose part in the error drifts or jumps over the writing order.

    None where the order is unknown. What acts as a gain of single scans is theirs, see ``order_trends``.
    """
    if len({scan.context.order for scan in left.scans}) < FEWEST_ORDERS:
        return None
    names = [f"{shape} {over}" for over in _OVER_ORDER for shape in _DRIFTING]
    penalty = np.eye(len(names))
    return _heights("order-shapes", names, _order_columns, penalty, left)


def _table(
    name: str,
    entries: Sequence[str],
    columns_of: ColumnsOf,
    left: Left,
    blocks: int = 1,
) -> LinearProbe:
    """One height per entry along an ordered covariate, or several of as many entries; bends kept small."""
    bends = np.kron(np.eye(blocks), second_differences(len(entries) // blocks))
    penalty = bends + 1e-3 * np.eye(len(entries))
    return _heights(name, entries, columns_of, penalty, left)


def _heights(
    name: str,
    entries: Sequence[str],
    columns_of: ColumnsOf,
    penalty: np.ndarray,
    left: Left,
) -> LinearProbe:
    """One height per entry, in nm for people; the control permutes the entries of each scan."""
    return linear_probe(
        name,
        columns_of,
        penalty,
        lambda random, count: random.permutation(count),
        lambda heights: {
            entry: (float(height) * NM_PER_UM, "nm") for entry, height in zip(entries, heights, strict=True)
        },
        left,
    )


def _power_columns(scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
    """``_POWERS`` of height (in heights of the highest level) and slopes (µm/µm), (m, y, x)."""
    height = prediction.astype(np.float64) / scan.context.full_height_um
    y, x = np.gradient(prediction.astype(np.float64), scan.stored.pitch_um)
    size_y, size_x = np.abs(y), np.abs(x)
    return np.stack(
        [
            *(height**2, height**3, y * y, x * x, y * x, y**3, x**3),
            *(height * slope for slope in (y, x, size_y, size_x)),
            *(height**2 * slope for slope in (size_y, size_x)),
        ]
    )


def _order_columns(scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
    """``_DRIFTING`` times order, and beyond each step of it, (m, y, x)."""
    order = scan.context.order
    squared = (prediction.astype(np.float64) / scan.context.full_height_um) ** 2
    drifting = np.stack([squared, *(_ALONG[axis](scan, prediction) for axis in "yx")])
    return np.concatenate([order * drifting, *((order > step) * drifting for step in ORDER_STEPS)])


def _level_columns(scan: PreparedScan, prediction: np.ndarray, levels: Sequence[int]) -> np.ndarray:
    """Blurred indicators (levels, y, x)."""
    sigma = SPOT_UM / scan.stored.pitch_um
    level = scan.stored.mask_level
    return np.stack(
        [gaussian_filter((level == one).astype(np.float64), sigma, mode="nearest") for one in levels]
    )


def _steepness(scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
    """|grad H| (y, x), µm/µm."""
    return np.hypot(*np.gradient(prediction.astype(np.float64), scan.stored.pitch_um))


def _along(scan: PreparedScan, prediction: np.ndarray, direction: float) -> np.ndarray:
    """|slope| (y, x) along a direction, radians from x to y; µm/µm."""
    y, x = np.gradient(prediction.astype(np.float64), scan.stored.pitch_um)
    return np.abs(np.cos(direction) * x + np.sin(direction) * y)


# Directions of a slope, by name.
_ALONG: Mapping[str, Steepness] = {
    "y": partial(_along, direction=np.pi / 2),
    "x": partial(_along, direction=0.0),
    "diagonal": partial(_along, direction=np.pi / 4),
    "antidiagonal": partial(_along, direction=3 * np.pi / 4),
}


def _slope_knots(steepness: Steepness, left: Left) -> np.ndarray:
    """From flat to what 1 % of the pixels exceed, so that no knot rests on a few edges."""
    sampled = [f.at_sample(steepness(f, p)) for f, p in zip(left.scans, left.predictions, strict=True)]
    steepest = float(np.quantile(np.concatenate(sampled), 0.99))
    return np.linspace(0.0, max(steepest, np.finfo(float).tiny), SLOPE_KNOTS)


def _slope_columns(
    scan: PreparedScan, prediction: np.ndarray, steepness: Steepness, knots: np.ndarray
) -> np.ndarray:
    """Tents (knots, y, x): 1 at a knot, 0 at its neighbours, constant beyond the ends."""
    place = np.interp(steepness(scan, prediction), knots, np.arange(len(knots)))
    return np.maximum(0.0, 1.0 - np.abs(place - np.arange(len(knots))[:, None, None]))


def _directed_slope_columns(
    scan: PreparedScan, prediction: np.ndarray, knots: Mapping[str, np.ndarray]
) -> np.ndarray:
    return np.concatenate([_slope_columns(scan, prediction, _ALONG[one], at) for one, at in knots.items()])
