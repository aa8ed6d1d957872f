"""Places: a map over the scan, or a profile over its rows or columns, of height, gain or displacement."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.prepared import PreparedScan, sample_border_px
from litho_models.loop.probes.linear import (
    Left,
    LinearProbe,
    Shuffle,
    linear_probe,
    second_differences,
)

# What goes with the place: an added height, a share of the height, or where the height lies along y and x.
Moved = Literal["height", "gain", "shift"]
SPLINES = 5
# One per µm in a scan of 25 µm: what is finer is one line's, not the scan's.
PROFILE_SPLINES = 24
Splines = Callable[[int, int], np.ndarray]
_FLIPS: tuple[Callable[[np.ndarray], np.ndarray], ...] = tuple(
    partial(lambda grid, turns, mirror: np.rot90(grid.T if mirror else grid, turns), turns=t, mirror=m)
    for t in range(4)
    for m in (False, True)
)


def position_map(left: Left, *, of: Moved) -> LinearProbe:
    """A smooth map over the scan, 5 × 5 cubic splines; for a shift one along y and one along x.

    What each scan may have by itself is projected out, so only what is finer can be found.
    """
    return _probe(_name("position", of, "map"), of, _grid, _roughness(SPLINES), _turned, drawn, left)


def profile(left: Left, *, along: Literal["row", "column"], of: Moved) -> LinearProbe:
    """A profile over the rows, or the columns, that all scans share, finer than a map can be."""
    penalty = second_differences(PROFILE_SPLINES) + 1e-2 * np.eye(PROFILE_SPLINES)
    splines = _rows if along == "row" else _columns
    return _probe(_name(along, of, "profile"), of, splines, penalty, _rolled, drawn_profile, left)


def drawn_profile(coefficients: np.ndarray, size: int = 201) -> np.ndarray:
    """The profile (size,) that the splines' coefficients stand for, over the sampled part."""
    return coefficients @ _splines(np.linspace(-1, 1, size), PROFILE_SPLINES)


def drawn(coefficients: np.ndarray, size: int = 101) -> np.ndarray:
    """The map (size, size) that the splines' coefficients stand for, over the sampled part; first axis y."""
    splines = _splines(np.linspace(-1, 1, size), SPLINES)
    return splines.T @ coefficients.reshape(SPLINES, SPLINES) @ splines


def shifts(coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The coefficients of a shift along y and of one along x."""
    along_y, along_x = np.split(coefficients, 2)
    return along_y, along_x


def _name(over: str, of: Moved, kind: str) -> str:
    return f"{over}-{kind}" if of == "height" else f"{over}-{of}-{kind}"


def _probe(
    name: str,
    of: Moved,
    splines: Splines,
    penalty: np.ndarray,
    shuffle: Shuffle,
    drawing: Callable[[np.ndarray], np.ndarray],
    left: Left,
) -> LinearProbe:
    if of == "shift":
        penalty, shuffle = np.kron(np.eye(2), penalty), partial(_both, shuffle=shuffle)
    return linear_probe(
        name,
        partial(_moved, of=of, splines=splines),
        penalty,
        shuffle,
        partial(_spread, of=of, drawing=drawing),
        left,
    )


def _moved(scan: PreparedScan, prediction: np.ndarray, of: Moved, splines: Splines) -> np.ndarray:
    """What each spline does to the print, (m, y, x); to first order in a shift, (2 m, y, x)."""
    maps = splines(*scan.stored.shape)
    if of == "height":
        return np.broadcast_to(maps, (len(maps), *scan.stored.shape))
    if of == "gain":
        return maps * prediction
    slopes = np.gradient(prediction.astype(np.float64), scan.stored.pitch_um)
    return np.concatenate([-maps * slope for slope in slopes])


def _spread(
    coefficients: np.ndarray, of: Moved, drawing: Callable[[np.ndarray], np.ndarray]
) -> dict[str, tuple[float, str]]:
    """Root mean square and range over the scan."""
    if of == "shift":
        parts = {f"{axis}_": drawing(one) for axis, one in zip("yx", shifts(coefficients), strict=True)}
        scale, unit = 1.0, "µm"
    else:
        parts = {"": drawing(coefficients)}
        scale, unit = (1.0, "1") if of == "gain" else (NM_PER_UM, "nm")
    return {
        name: (value * scale, unit)
        for axis, values in parts.items()
        for name, value in (
            (f"{axis}rms", float(values.std())),
            (f"{axis}peak_to_valley", float(np.ptp(values))),
        )
    }


def _grid(ny: int, nx: int) -> np.ndarray:
    """Products of splines along y and x over a scan (25, y, x)."""
    return np.einsum("iy,jx->ijyx", _over(ny), _over(nx)).reshape(-1, ny, nx)


def _rows(ny: int, nx: int) -> np.ndarray:
    """Splines over the rows (24, y, 1)."""
    return _over(ny, PROFILE_SPLINES)[:, :, None]


def _columns(ny: int, nx: int) -> np.ndarray:
    """Splines over the columns (24, 1, x)."""
    return _over(nx, PROFILE_SPLINES)[:, None, :]


def map_columns_at(scan: PreparedScan, at: np.ndarray) -> np.ndarray:
    """The splines of ``position_map`` at flat indices of a scan, (25, n)."""
    (ny, nx), (y, x) = scan.stored.shape, np.divmod(at, scan.stored.shape[1])
    return (_over(ny)[:, None, y] * _over(nx)[None, :, x]).reshape(-1, len(at))


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


def _both(random: np.random.Generator, count: int, shuffle: Shuffle) -> np.ndarray:
    """One order for the coefficients of both axes."""
    order = shuffle(random, count // 2)
    return np.concatenate([order, order + count // 2])
