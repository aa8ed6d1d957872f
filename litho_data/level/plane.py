"""Remove tilt and set zero as Gwyddion does: with planes by fit, by points, or by the prevailing facet."""

from collections.abc import Callable
from typing import Annotated

import numpy as np
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import YX, Array
from litho_data.level.operation import operation
from litho_data.level.polynomial import fit_terms, polynomial_terms
from litho_data.level.selection import Levelled, subtract

_FEWEST_CELLS = 4


@operation("plane")
def level_plane(z: Array, chosen: Array) -> Levelled:
    """Subtract the tilt of the least-squares plane; the height at the pivot (nx/2, ny/2) stays.

    As Gwyddion defines it, the fitted constant is replaced by -(bx nx + by ny) / 2, with slopes in height per
    pixel, so that the mean changes by (bx + by) / 2.

    Raises:
        InputError: the selected pixels do not determine a plane. (Gwyddion then removes nothing.)
    """
    coefficients = fit_terms(z, chosen, polynomial_terms(1, 1, 1))
    # The plane is fitted in coordinates from -1 to 1.
    ny, nx = z.shape
    return _without_tilt(z, 2 * coefficients[0, 1] / (nx - 1), 2 * coefficients[1, 0] / (ny - 1))


@operation("three-point")
def level_three_point(
    z: Array,
    chosen: Array,
    *,
    points_px: tuple[YX, YX, YX],
    radius_px: Annotated[float, Field(ge=0)] = 0.0,
    set_zero: bool = False,
) -> Levelled:
    """Subtract the plane through three points, each of which is the mean over a disc.

    Args:
        points_px: three (y, x) positions in pixel indices.
        radius_px: radius of the disc; 0 takes the one pixel.
        set_zero: put the three points to zero; otherwise the height at the pivot (nx/2, ny/2)
            stays, as in ``level_plane``.

    Raises:
        InputError: not three points, a disc without a selected pixel, or points on one line.
    """
    heights = [_disc_mean(z, chosen, point, radius_px) for point in points_px]
    design = np.array([[1.0, x, y] for y, x in points_px])
    if abs(np.linalg.det(design)) < 1e-9 * z.size:
        raise InputError(
            "three-point levelling", got=f"points {list(points_px)}", wanted="points not on one line"
        )
    constant, slope_x, slope_y = np.linalg.solve(design, heights)
    at_pivot = constant + slope_x * z.shape[1] / 2 + slope_y * z.shape[0] / 2
    return _without_tilt(z, slope_x, slope_y, at_pivot if set_zero else 0.0)


def _disc_mean(z: Array, chosen: Array, point: YX, radius: float) -> float:
    if not (0 <= point[0] <= z.shape[0] - 1 and 0 <= point[1] <= z.shape[1] - 1):
        raise InputError("three-point levelling: point (y, x)", got=point, wanted=f"a pixel of {z.shape}")
    y, x = (np.arange(n) - centre for n, centre in zip(z.shape, point, strict=True))
    distance2 = np.add.outer(y**2, x**2)
    disc = chosen & (distance2 <= max(radius**2, distance2.min()))
    if not disc.any():
        raise InputError("three-point levelling", got=f"no selected pixel within {radius} px of {point}")
    return float(z[disc].mean())


@operation("facet")
def level_facet(z: Array, chosen: Array, *, pitch_um: YX) -> Levelled:
    """Subtract the tilt of the prevailing facet; the height at the pivot (nx/2, ny/2) stays.

    ``prevailing_slope`` is applied to the slopes of all 2 x 2 cells whose pixels are selected, with s² = mean
    |v|² / 20, until the change falls below sqrt(1e-9), the limit of Gwyddion 2.62. (The limit of version
    2.45, 1e-8, changes the result by 2e-3 of the range.)

    Args:
        z: (ny, nx), µm: slopes are physical, so height and pitch must share a unit.
        pitch_um: (y, x) sampling, µm.

    Raises:
        InputError: fewer than 4 usable cells. (Gwyddion then removes nothing.)
    """
    diagonal, other = z[1:, 1:] - z[:-1, :-1], z[:-1, 1:] - z[1:, :-1]
    whole = chosen[1:, 1:] & chosen[:-1, :-1] & chosen[:-1, 1:] & chosen[1:, :-1]
    pitch_y, pitch_x = pitch_um
    slopes = np.stack([(diagonal + other)[whole] / (2 * pitch_x), (diagonal - other)[whole] / (2 * pitch_y)])
    if slopes.shape[1] < _FEWEST_CELLS:
        got = f"{slopes.shape[1]} cells of 2 x 2 selected pixels"
        raise InputError("facet levelling", got=got, wanted="4 or more")
    slope_x, slope_y = prevailing_slope(slopes, sharpness=1 / 20, passes=100, settled2=1e-9)
    return _without_tilt(z, slope_x * pitch_x, slope_y * pitch_y)


def prevailing_slope(slopes: Array, *, sharpness: float, passes: int, settled2: float) -> Array:
    """Return the slope (d,) of the prevailing facet among slopes v (d, n).

    The mean with the weights exp(-|v|² / s²), s² = sharpness · mean |v|², is subtracted up to ``passes``
    times, until its square is below ``settled2``.
    """
    total = np.zeros(len(slopes))
    for _ in range(passes):
        squares = (slopes**2).sum(axis=0)
        spread = float(squares.mean()) * sharpness
        if spread == 0.0:
            break
        weights = np.exp(squares / -spread)
        step = slopes @ weights / weights.sum()
        slopes = slopes - step[:, None]
        total += step
        if step @ step < settled2:
            break
    return total


def _without_tilt(z: Array, slope_x: float, slope_y: float, at_pivot: float = 0.0) -> Levelled:
    """Subtract the plane with these slopes per pixel and this height at column nx/2, row ny/2."""
    y, x = (np.arange(n) - n / 2 for n in z.shape)
    return subtract(z, np.add.outer(slope_y * y + at_pivot, slope_x * x))


@operation("fix-zero")
def fix_zero(z: Array, chosen: Array) -> Levelled:
    """Move the lowest selected pixel to zero. The zero is then the height of one pixel, not a physical
    datum.
    """
    return _shift(z, np.min, chosen)


@operation("zero-mean")
def zero_mean(z: Array, chosen: Array) -> Levelled:
    """Move the mean of the selected pixels to zero."""
    return _shift(z, np.mean, chosen)


@operation("zero-max")
def zero_max(z: Array, chosen: Array) -> Levelled:
    """Move the highest selected pixel to zero."""
    return _shift(z, np.max, chosen)


def _shift(z: Array, statistic: Callable[[Array], float], chosen: Array) -> Levelled:
    return subtract(z, np.broadcast_to(np.float64(statistic(z[chosen])), z.shape))
