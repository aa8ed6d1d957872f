"""Remove the tilt of a scan, and choose which height is zero, by the same rules as Gwyddion. The tilt is
measured by a fitted plane or by the prevailing facet, i.e. the most common orientation of the surface.
"""

from collections.abc import Callable

import numpy as np

from litho_data.foundation import YX, Array, InputError
from litho_data.level.operation import operation
from litho_data.level.polynomial import fit_terms, polynomial_terms
from litho_data.level.selection import Levelled, subtract

_FEWEST_CELLS = 4


@operation("plane")
def level_plane(z: Array, chosen: Array) -> Levelled:
    """Subtract the tilt of the least-squares plane. The height at the pivot (column nx/2, row ny/2) does not
    change.

    As in Gwyddion, the constant term of the subtracted plane is not fitted but set to -(bx nx + by ny) / 2,
    where bx and by are the slopes of the plane in height per pixel. The mean height of the scan therefore
    changes by (bx + by) / 2.

    Raises:
        InputError: the selected pixels do not determine a plane. (Gwyddion removes nothing in this case.)
    """
    coefficients = fit_terms(z, chosen, polynomial_terms(1, 1, 1))
    # `fit_terms` uses coordinates from -1 to 1, so its slopes are converted to height per pixel.
    ny, nx = z.shape
    return _without_tilt(z, 2 * coefficients[0, 1] / (nx - 1), 2 * coefficients[1, 0] / (ny - 1))


@operation("facet")
def level_facet(z: Array, chosen: Array, *, pitch_um: YX) -> Levelled:
    """Subtract the tilt of the prevailing facet. The height at the pivot (column nx/2, row ny/2) does not
    change.

    The function ``prevailing_slope`` finds the tilt in several passes, from the slopes v of all 2 x 2 cells
    whose four pixels are selected. Each pass averages the slopes with the weights exp(-|v|² / s²), where s² =
    mean |v|² / 20. The passes end when the tilt changes by less than sqrt(1e-9), as in Gwyddion 2.62.
    (Gwyddion 2.45 uses the limit sqrt(1e-8), which changes the result by 2e-3 of the height range.)

    Args:
        z: heights in µm, shape (ny, nx). Slopes are computed as height / length, so heights and pitch must
            have the same unit.
        pitch_um: pixel pitch along y and x, µm.

    Raises:
        InputError: fewer than 4 cells are usable. (Gwyddion removes nothing in this case.)
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
    """Return the slope of the prevailing facet, given the slopes v of n cells in d directions. ``slopes`` has
    shape (d, n), and the result has shape (d,).

    Each pass computes the mean of v with the weights exp(-|v|² / s²), where s² = sharpness · mean |v|², and
    subtracts this mean from v. The passes end when the squared length of this mean is below ``settled2``, or
    after ``passes`` passes. The result is the sum of the subtracted means.
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


def _without_tilt(z: Array, slope_x: float, slope_y: float) -> Levelled:
    """Subtract the plane that has the given slopes, in height per pixel, and is zero at column nx/2 and row
    ny/2.
    """
    y, x = (np.arange(n) - n / 2 for n in z.shape)
    return subtract(z, np.add.outer(slope_y * y, slope_x * x))


@operation("fix-zero")
def fix_zero(z: Array, chosen: Array) -> Levelled:
    """Shift the heights so that the lowest selected pixel has the height zero.

    The zero is then the height of a single pixel, not a physical datum.
    """
    return _shift(z, np.min, chosen)


@operation("zero-mean")
def zero_mean(z: Array, chosen: Array) -> Levelled:
    """Shift the heights so that the mean of the selected pixels is zero."""
    return _shift(z, np.mean, chosen)


@operation("zero-max")
def zero_max(z: Array, chosen: Array) -> Levelled:
    """Shift the heights so that the highest selected pixel has the height zero."""
    return _shift(z, np.max, chosen)


def _shift(z: Array, statistic: Callable[[Array], float], chosen: Array) -> Levelled:
    return subtract(z, np.broadcast_to(np.float64(statistic(z[chosen])), z.shape))
