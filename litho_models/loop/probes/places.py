"""Places: a smooth map over the scan, or a profile over its rows or columns, added or times the height."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.prepared import PreparedScan, sample_border_px
from litho_models.loop.probes.linear import Left, LinearProbe, linear_probe, second_differences

SPLINES = 5
# One per µm in a scan of 25 µm: what is finer is one line's, not the scan's.
PROFILE_SPLINES = 24
_FLIPS: tuple[Callable[[np.ndarray], np.ndarray], ...] = tuple(
    partial(lambda grid, turns, mirror: np.rot90(grid.T if mirror else grid, turns), turns=t, mirror=m)
    for t in range(4)
    for m in (False, True)
)


def position_map(
    left: Left,
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
        partial(_spread, drawn, times_height=times_height),
        left,
    )


def profile(
    left: Left,
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
        partial(_spread, drawn_profile, times_height=times_height),
        left,
    )


def drawn_profile(coefficients: np.ndarray, size: int = 201) -> np.ndarray:
    """The profile (size,) that the splines' coefficients stand for, over the sampled part."""
    return coefficients @ _splines(np.linspace(-1, 1, size), PROFILE_SPLINES)


def drawn(coefficients: np.ndarray, size: int = 101) -> np.ndarray:
    """The map (size, size) that the splines' coefficients stand for, over the sampled part; first axis y."""
    splines = _splines(np.linspace(-1, 1, size), SPLINES)
    return splines.T @ coefficients.reshape(SPLINES, SPLINES) @ splines


def _spread(
    drawing: Callable[[np.ndarray], np.ndarray], coefficients: np.ndarray, times_height: bool
) -> dict[str, tuple[float, str]]:
    values = drawing(coefficients)
    scale, unit = (1.0, "1") if times_height else (NM_PER_UM, "nm")
    return {
        "rms": (float(values.std()) * scale, unit),
        "peak_to_valley": (float(np.ptp(values)) * scale, unit),
    }


def _map_columns(scan: PreparedScan, prediction: np.ndarray, times_height: bool) -> np.ndarray:
    """Products of splines along y and x over the scan (25, y, x)."""
    along_y, along_x = (_over(n) for n in scan.stored.shape)
    maps = np.einsum("iy,jx->ijyx", along_y, along_x).reshape(-1, *scan.stored.shape)
    return maps * prediction if times_height else maps


def map_columns_at(scan: PreparedScan, at: np.ndarray) -> np.ndarray:
    """The splines of ``position_map`` at flat indices of a scan, (25, n)."""
    (ny, nx), (y, x) = scan.stored.shape, np.divmod(at, scan.stored.shape[1])
    return (_over(ny)[:, None, y] * _over(nx)[None, :, x]).reshape(-1, len(at))


def _profile_columns(
    scan: PreparedScan, prediction: np.ndarray, along: Literal["row", "column"], times_height: bool
) -> np.ndarray:
    """Splines over the rows or the columns (24, y, x)."""
    ny, nx = scan.stored.shape
    splines = _over(ny if along == "row" else nx, PROFILE_SPLINES)
    maps = splines[:, :, None] if along == "row" else splines[:, None, :]
    return np.broadcast_to(maps, (PROFILE_SPLINES, ny, nx)) * (prediction if times_height else 1.0)


def _over(size: int, count: int = SPLINES) -> np.ndarray:
    """Cubic splines (count, size) over the sampled part of an axis, constant beyond it.

    A spline that only pixels beyond it hold would be drawn there without having been measured.
    """
    first = sample_border_px(size)
    return _splines(np.interp(np.arange(size), [first, size - 1 - first], [-1.0, 1.0]), count)


def _splines(position: np.ndarray, count: int) -> np.ndarray:
    """Cubic splines (count, n) at positions from -1 to 1; they add up to 1."""
    inner = np.linspace(-1, 1, count - 2)
    knots = np.concatenate([[-1.0] * 3, inner, [1.0] * 3])
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
