"""Datum and tilt, as in Gwyddion: where zero lies, planes by fit, points, rotation or prevailing facet."""

from collections.abc import Callable
from typing import Annotated

import numpy as np
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import YX, Array, Shape
from litho_data.level.operation import operation
from litho_data.level.polynomial import Terms, fit_terms
from litho_data.level.selection import Levelled, subtract, subtract_product

PLANE: Terms = ((0, 0), (1, 0), (0, 1))


@operation("plane")
def level_plane(z: Array, chosen: Array | None) -> Levelled:
    """Subtract the tilt of the least-squares plane; the height at the pivot (nx/2, ny/2) stays.

    Gwyddion's definition: the fitted constant is replaced by -(bx nx + by ny) / 2, slopes in height per
    pixel, so that the mean changes by (bx + by) / 2.

    Raises:
        InputError: the selected pixels do not determine a plane. (Gwyddion then removes nothing.)
    """
    return subtract_tilt(z, slopes_per_px(fit_terms(z, chosen, PLANE), z.shape))


@operation("three-point")
def level_three_point(
    z: Array,
    chosen: Array | None,
    *,
    points_px: tuple[YX, YX, YX],
    radius_px: Annotated[float, Field(ge=0)] = 0.0,
    set_zero: bool = False,
) -> Levelled:
    """Subtract the plane through three points, each the mean over a disc.

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
    return subtract_tilt(z, (slope_x, slope_y), at_pivot if set_zero else 0.0)


def slopes_per_px(coefficients: Array, shape: Shape) -> tuple[float, float]:
    """(along x, along y) slope in height per pixel of ``fit_terms``'s linear terms."""
    return 2 * coefficients[0, 1] / (shape[1] - 1), 2 * coefficients[1, 0] / (shape[0] - 1)


def subtract_tilt(z: Array, slopes: tuple[float, float], at_pivot: float = 0.0) -> Levelled:
    """The map minus the plane with these slopes (x, y) per pixel and this height at column nx/2, row ny/2."""
    ny, nx = z.shape
    along_y = slopes[1] * (np.arange(ny) - ny / 2) + at_pivot
    along_x = slopes[0] * (np.arange(nx) - nx / 2)
    return subtract_product(z, np.stack([along_y, np.ones(ny)], axis=1), np.stack([np.ones(nx), along_x]))


def _disc_mean(z: Array, chosen: Array | None, point: YX, radius: float) -> float:
    y, x = (np.arange(n) - centre for n, centre in zip(z.shape, point, strict=True))
    distance2 = np.add.outer(y**2, x**2)
    disc = distance2 <= max(radius**2, distance2.min())
    if not (0 <= point[0] <= z.shape[0] - 1 and 0 <= point[1] <= z.shape[1] - 1):
        raise InputError("three-point levelling: point (y, x)", got=point, wanted=f"a pixel of {z.shape}")
    if chosen is not None:
        disc &= chosen
    if not disc.any():
        raise InputError("three-point levelling", got=f"no selected pixel within {radius} px of {point}")
    return float(z[disc].mean())


@operation("rotate")
def level_rotate(
    z: Array,
    chosen: Array | None,
    *,
    pitch_um: YX,
) -> Levelled:
    """Rotate by the angles of the least-squares plane, first every row, then every column.

    Subtracting a plane shears the surface, which stretches steep flanks; rotating keeps their
    shape. Each profile turns about its middle pixel and is interpolated linearly at the old
    positions; what turns out of the image is continued by the outermost value.

    Args:
        z: (ny, nx), µm; every pixel must be measured.
        pitch_um: (y, x) sampling, µm, in the unit of the heights.

    Raises:
        InputError: missing pixels, or an angle at which the surface would overhang.
    """
    if not np.isfinite(z).all():
        raise InputError("rotation of a scan with missing pixels", wanted="every pixel measured")
    slope_x, slope_y = slopes_per_px(fit_terms(z, chosen, PLANE), z.shape)
    turned = _rotate_rows(z, slope_x / pitch_um[1], pitch_um[1])
    turned = _rotate_rows(turned.T, slope_y / pitch_um[0], pitch_um[0]).T
    return Levelled(np.ascontiguousarray(turned), z - turned)


def _rotate_rows(z: Array, slope: float, pitch_um: float) -> Array:
    angle = -np.arctan(slope)
    position = (np.arange(z.shape[1]) - (z.shape[1] - 1) / 2) * pitch_um
    # Rotating about the middle of the profile keeps the height of the middle, whatever the datum.
    last = z.shape[1] - 1
    pivot = 0.5 * (z[:, last // 2] + z[:, (last + 1) // 2])[:, None]
    moved_x = position * np.cos(angle) - (z - pivot) * np.sin(angle)
    moved_z = position * np.sin(angle) + (z - pivot) * np.cos(angle) + pivot
    if (np.diff(moved_x, axis=1) <= 0).any():
        raise InputError(
            "rotation makes the surface overhang", got=f"{np.degrees(angle):.3g}°", wanted="level_plane"
        )
    return np.stack([np.interp(position, x, row) for x, row in zip(moved_x, moved_z, strict=True)])


@operation("fix-zero")
def fix_zero(z: Array, chosen: Array | None) -> Levelled:
    """Move the lowest selected pixel to zero. This is the height of one pixel, not a physical datum."""
    return _shift(z, np.min, chosen)


@operation("zero-mean")
def zero_mean(z: Array, chosen: Array | None) -> Levelled:
    """Move the mean of the selected pixels to zero."""
    return _shift(z, np.mean, chosen)


@operation("zero-max")
def zero_max(z: Array, chosen: Array | None) -> Levelled:
    """Move the highest selected pixel to zero."""
    return _shift(z, np.max, chosen)


def _shift(z: Array, statistic: Callable[[Array], float], chosen: Array | None) -> Levelled:
    return subtract(z, np.broadcast_to(np.float64(statistic(z if chosen is None else z[chosen])), z.shape))


_MAX_PASSES = 100
# Gwyddion 2.62; version 2.45 stopped at 1e-8, which moves the result by 2e-3 of the range.
_CONVERGED = 1e-9
_SHARPNESS = 1 / 20
_FEWEST_CELLS = 4


@operation("facet")
def level_facet(
    z: Array,
    chosen: Array | None,
    *,
    pitch_um: YX,
) -> Levelled:
    """Subtract the tilt of the prevailing facet; the height at the pivot (nx/2, ny/2) stays.

    Slopes v of all 2 x 2 cells whose pixels are selected are averaged with the weights
    exp(-|v|^2 / s^2), s^2 = mean |v|^2 / 20, and subtracted until their change falls below
    sqrt(1e-9).

    Args:
        z: (ny, nx), µm: slopes are physical, so height and pitch must share a unit.
        pitch_um: (y, x) sampling, µm.

    Raises:
        InputError: fewer than 4 usable cells. (Gwyddion then removes nothing.)
    """
    slope_x, slope_y = _cell_slopes(z, chosen, pitch_um)
    if slope_x.size < _FEWEST_CELLS:
        raise InputError(
            "facet levelling", got=f"{slope_x.size} cells of 2 x 2 selected pixels", wanted="4 or more"
        )
    total_x = total_y = 0.0
    for _ in range(_MAX_PASSES):
        # Subtracting a plane only shifts all slopes, so the map itself need not change in between.
        step_x, step_y = facet_pass(slope_x, slope_y)
        total_x += step_x
        total_y += step_y
        if step_x**2 + step_y**2 < _CONVERGED:
            break
    return subtract_tilt(z, (total_x * pitch_um[1], total_y * pitch_um[0]))


def _cell_slopes(z: Array, chosen: Array | None, pitch_um: YX) -> tuple[Array, Array]:
    diagonal = z[1:, 1:] - z[:-1, :-1]
    other = z[:-1, 1:] - z[1:, :-1]
    slope_x = (diagonal + other) * (0.5 / pitch_um[1])
    slope_y = (diagonal - other) * (0.5 / pitch_um[0])
    if chosen is None:
        return slope_x.ravel(), slope_y.ravel()
    whole = chosen[1:, 1:] & chosen[:-1, :-1] & chosen[:-1, 1:] & chosen[1:, :-1]
    return slope_x[whole], slope_y[whole]


def facet_pass(slope_x: Array, slope_y: Array) -> tuple[float, float]:
    """One pass: subtract the prevailing slope from the slopes, in place, and return it."""
    weights = slope_x * slope_x
    weights += slope_y * slope_y
    spread = float(weights.mean()) * _SHARPNESS
    if spread == 0.0:
        return 0.0, 0.0
    weights *= -1 / spread
    np.exp(weights, out=weights)
    total = float(weights.sum())
    step_x, step_y = float(weights @ slope_x) / total, float(weights @ slope_y) / total
    slope_x -= step_x
    slope_y -= step_y
    return step_x, step_y
