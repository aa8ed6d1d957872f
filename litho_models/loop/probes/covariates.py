"""Linear probes along the printed level, the steepness, the place in the field and its rows or columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline
from scipy.ndimage import gaussian_filter

from litho_models.loop.fields import Field
from litho_models.loop.probes.linear import ColumnsOf, LinearProbe, linear_probe, second_differences
from litho_models.metrics import NM_PER_UM

# The level that reaches a pixel is spread by the printer's spot.
SPOT_UM = 0.2
SPLINES = 5
SLOPE_KNOTS = 8
# One per µm in a field of 25 µm: what is finer is one line's, not the field's.
PROFILE_SPLINES = 24
_FEWEST_SCANS, _SMALLEST_SHARE = 5, 0.01
_FLIPS: tuple[Callable[[np.ndarray], np.ndarray], ...] = tuple(
    partial(lambda grid, turns, mirror: np.rot90(grid.T if mirror else grid, turns), turns=t, mirror=m)
    for t in range(4)
    for m in (False, True)
)


def level_table(
    fields: Sequence[Field], predictions: Sequence[np.ndarray], kept: Sequence[np.ndarray]
) -> LinearProbe | None:
    """One height correction per printed level; None where fewer than four levels can be estimated.

    Offset and slope over the levels belong to each scan's datum and gain and are projected out with them.
    Levels in fewer than 5 scans or 1 % of the pixels are left alone.
    """
    levels = estimated_levels(fields)
    if len(levels) < 4:
        return None
    entries = [f"level_{level}" for level in levels]
    columns_of = partial(_level_columns, levels=levels)
    return _table("level-table", entries, columns_of, fields, predictions, kept)


def estimated_levels(fields: Sequence[Field]) -> list[int]:
    """Levels that enough scans and pixels hold."""
    highest = max(int(field.scan.levels) for field in fields)
    counts = np.stack(
        [np.bincount(field.scan.mask_level.ravel().astype(int), minlength=highest) for field in fields]
    )
    shares = counts.sum(axis=0) / counts.sum()
    enough = (counts > 0).sum(axis=0) >= min(_FEWEST_SCANS, len(fields))
    return [int(level) for level in np.flatnonzero(enough & (shares >= _SMALLEST_SHARE))]


def slope_table(
    fields: Sequence[Field], predictions: Sequence[np.ndarray], kept: Sequence[np.ndarray]
) -> LinearProbe:
    """One height correction per steepness of the predicted print, linear in between.

    The steepest knot is exceeded by 1 % of the pixels only, so that no knot rests on a few edges.
    """
    steepness = [
        field.at_sample(_steepness(field, prediction))
        for field, prediction in zip(fields, predictions, strict=True)
    ]
    steepest = float(np.quantile(np.concatenate(steepness), 0.99))
    knots = np.linspace(0.0, max(steepest, np.finfo(float).tiny), SLOPE_KNOTS)
    entries = [f"slope_{knot:.2f}" for knot in knots]
    return _table("slope-table", entries, partial(_slope_columns, knots=knots), fields, predictions, kept)


def _table(
    name: str,
    entries: Sequence[str],
    columns_of: ColumnsOf,
    fields: Sequence[Field],
    predictions: Sequence[np.ndarray],
    kept: Sequence[np.ndarray],
) -> LinearProbe:
    """One height per entry along an ordered covariate, bends kept small."""
    return linear_probe(
        name,
        columns_of,
        second_differences(len(entries)) + 1e-3 * np.eye(len(entries)),
        lambda random, count: random.permutation(count),
        lambda heights: {
            entry: (float(height) * NM_PER_UM, "nm") for entry, height in zip(entries, heights, strict=True)
        },
        fields,
        predictions,
        kept,
    )


def position_map(
    fields: Sequence[Field],
    predictions: Sequence[np.ndarray],
    kept: Sequence[np.ndarray],
    *,
    times_height: bool,
) -> LinearProbe:
    """A smooth map over the scan, 5 × 5 cubic splines, added or multiplied by the height.

    Each scan's plane and bow are projected out, so only what is finer can be found.
    """
    return linear_probe(
        "position-gain-map" if times_height else "position-map",
        partial(_map_columns, times_height=times_height),
        _roughness(SPLINES),
        _turned,
        partial(_size, times_height=times_height),
        fields,
        predictions,
        kept,
    )


def profile(
    fields: Sequence[Field],
    predictions: Sequence[np.ndarray],
    kept: Sequence[np.ndarray],
    *,
    along: Literal["row", "column"],
    times_height: bool,
) -> LinearProbe:
    """A profile over the rows, or the columns, that all scans share, finer than a map can be."""
    return linear_probe(
        f"{along}-gain-profile" if times_height else f"{along}-profile",
        partial(_profile_columns, along=along, times_height=times_height),
        second_differences(PROFILE_SPLINES) + 1e-2 * np.eye(PROFILE_SPLINES),
        _rolled,
        partial(_profile_size, times_height=times_height),
        fields,
        predictions,
        kept,
    )


def drawn_profile(coefficients: np.ndarray, size: int = 201) -> np.ndarray:
    """The profile (size,) that the splines' coefficients stand for, from one end to the other."""
    return coefficients @ _splines(size, PROFILE_SPLINES)


def drawn(coefficients: np.ndarray, size: int = 101) -> np.ndarray:
    """The map (size, size) that the splines' coefficients stand for; first axis y."""
    splines = _splines(size)
    return splines.T @ coefficients.reshape(SPLINES, SPLINES) @ splines


def _size(coefficients: np.ndarray, times_height: bool) -> dict[str, tuple[float, str]]:
    return _spread(drawn(coefficients), times_height)


def _profile_size(coefficients: np.ndarray, times_height: bool) -> dict[str, tuple[float, str]]:
    return _spread(drawn_profile(coefficients), times_height)


def _spread(values: np.ndarray, times_height: bool) -> dict[str, tuple[float, str]]:
    scale, unit = (1.0, "1") if times_height else (NM_PER_UM, "nm")
    return {
        "rms": (float(values.std()) * scale, unit),
        "peak_to_valley": (float(np.ptp(values)) * scale, unit),
    }


def _level_columns(field: Field, prediction: np.ndarray, levels: Sequence[int]) -> np.ndarray:
    """Blurred indicators (levels, y, x)."""
    sigma = SPOT_UM / field.scan.pitch_um
    level = field.scan.mask_level
    return np.stack(
        [gaussian_filter((level == one).astype(np.float64), sigma, mode="nearest") for one in levels]
    )


def _steepness(field: Field, prediction: np.ndarray) -> np.ndarray:
    """|grad H| (y, x), µm/µm."""
    along_y, along_x = np.gradient(prediction.astype(np.float64), field.scan.pitch_um)
    return np.hypot(along_y, along_x)


def _slope_columns(field: Field, prediction: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Tents (knots, y, x): 1 at a knot, 0 at its neighbours, constant beyond the ends."""
    place = np.interp(_steepness(field, prediction), knots, np.arange(len(knots)))
    return np.maximum(0.0, 1.0 - np.abs(place - np.arange(len(knots))[:, None, None]))


def _map_columns(field: Field, prediction: np.ndarray, times_height: bool) -> np.ndarray:
    """Products of splines along y and x over the scan (25, y, x)."""
    along_y, along_x = (_splines(n) for n in field.scan.shape)
    maps = np.einsum("iy,jx->ijyx", along_y, along_x).reshape(-1, *field.scan.shape)
    return maps * prediction if times_height else maps


def _profile_columns(
    field: Field, prediction: np.ndarray, along: Literal["row", "column"], times_height: bool
) -> np.ndarray:
    """Splines over the rows or the columns (24, y, x)."""
    ny, nx = field.scan.shape
    splines = _splines(ny if along == "row" else nx, PROFILE_SPLINES)
    maps = splines[:, :, None] if along == "row" else splines[:, None, :]
    return np.broadcast_to(maps, (PROFILE_SPLINES, ny, nx)) * (prediction if times_height else 1.0)


def _splines(size: int, count: int = SPLINES) -> np.ndarray:
    """Cubic splines (count, size) from one end of an axis to the other; they add up to 1."""
    inner = np.linspace(-1, 1, count - 2)
    knots = np.concatenate([[-1.0] * 3, inner, [1.0] * 3])
    position = np.linspace(-1, 1, size)
    return BSpline.design_matrix(position, knots, 3).toarray().T


def _roughness(count: int) -> np.ndarray:
    """Penalty on the bends of a grid of coefficients along both axes, a little on their size."""
    one = second_differences(count)
    return np.kron(one, np.eye(count)) + np.kron(np.eye(count), one) + 1e-2 * np.eye(count**2)


def _turned(random: np.random.Generator, count: int) -> np.ndarray:
    """Order of the coefficients after a random flip or quarter turn of the map."""
    side = round(count**0.5)
    grid = np.arange(count).reshape(side, side)
    return _FLIPS[int(random.integers(len(_FLIPS)))](grid).ravel()


def _rolled(random: np.random.Generator, count: int) -> np.ndarray:
    """Order of the coefficients after a random shift, and half of the time a reversal, of the profile."""
    order = np.roll(np.arange(count), int(random.integers(count)))
    return order[::-1] if random.random() < 0.5 else order
