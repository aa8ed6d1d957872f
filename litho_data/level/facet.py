"""Facet levelling: make the most common facet orientation horizontal (Gwyddion's Facet Level)."""

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import YX, Array
from litho_data.level.operation import operation
from litho_data.level.plane import subtract_tilt
from litho_data.level.selection import Levelled, Masking, as_height, select

_MAX_PASSES = 100
# Gwyddion 2.62; version 2.45 stopped at 1e-8, which moves the result by 2e-3 of the range.
_CONVERGED = 1e-9
_SHARPNESS = 1 / 20
_FEWEST_CELLS = 4


@operation("facet")
def level_facet(
    height_um: Array,
    *,
    pitch_um: YX,
    mask: Array | None = None,
    masking: Masking = "exclude",
) -> Levelled:
    """Subtract the tilt of the prevailing facet; the height at the pivot (nx/2, ny/2) stays.

    Slopes v of all 2 x 2 cells whose pixels are selected are averaged with the weights
    exp(-|v|^2 / s^2), s^2 = mean |v|^2 / 20, and subtracted until their change falls below
    sqrt(1e-9).

    Args:
        height_um: (ny, nx), µm: slopes are physical, so height and pitch must share a unit.
        pitch_um: (y, x) sampling, µm.

    Raises:
        InputError: fewer than 4 usable cells. (Gwyddion then removes nothing.)
    """
    z = as_height(height_um)
    chosen = select(z, mask, masking)
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
