"""Find and remove scars: short streaks along the fast axis, where the feedback of the microscope lost the
surface.
"""

from functools import wraps
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from scipy import ndimage

from litho_data.foundation import Array, InputError
from litho_data.level.operation import operation
from litho_data.level.selection import Levelled, as_height, subtract

ScarSign = Literal["both", "positive", "negative"]
Threshold = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]


@operation("mark-scars")
def mark_scars(
    z: Array,
    chosen: Array,
    *,
    high: Threshold = 0.666,
    low: Threshold = 0.25,
    min_length_px: Count = 16,
    max_width_px: Count = 4,
    sign: ScarSign = "both",
) -> Array:
    """Mark scars, which are streaks along the rows that are higher or lower than the rows above and below
    them.

    A streak may be up to ``max_width_px`` rows wide. The prominence of a streak is computed in each column.
    It is the lowest height of the streak minus the height of the pixel directly above or below the streak,
    whichever is higher. Negative streaks are found in the same way after the sign of the heights is reversed.
    The prominence is stated in units of the rms difference between rows, sqrt(sum of squared differences
    between neighbouring rows / number of pixels). A run of at least ``min_length_px`` pixels along a row is a
    scar if its prominence reaches ``high`` somewhere and never falls below ``low``.

    Returns:
        A bool array of shape (ny, nx). Only selected pixels are marked.

    Raises:
        InputError: a threshold or size is outside its range, or the sign is unknown.
    """
    if low > high:
        raise InputError(
            "scar parameters", got=f"low {low} and high {high}", wanted="low at most as large as high"
        )
    steps = np.diff(z, axis=0)
    rms = np.sqrt(float(np.nansum(steps**2)) / z.size)
    scars = np.zeros(z.shape, dtype=bool)
    if rms == 0.0:
        return scars
    for direction in (1, -1):
        if sign in ("both", "positive" if direction > 0 else "negative"):
            prominence = _prominence(direction * z, max_width_px) / rms
            scars |= _long_runs(prominence, low, high, min_length_px)
    return scars & chosen


def remove_scars(height: Array, *, scars: Array) -> Levelled:
    """Replace the marked pixels by a harmonic surface, i.e. a smooth interpolation from the pixels around
    them.

    Laplace's equation is solved inside the marked areas. At the border of the image, the derivative across
    the border is zero. The values of all unmarked pixels do not change at all, so ``removed`` is zero at
    these pixels.

    Raises:
        InputError: ``scars`` is not a bool array of the shape of the heights, or a marked area has no
            measured pixel next to it.
    """
    z = as_height(height)
    if scars.shape != z.shape or scars.dtype != np.bool_:
        raise InputError("scar mask", got=f"{scars.dtype} {scars.shape}", wanted=f"bool {z.shape}")
    removed = np.zeros_like(z)
    unknown = scars & np.isfinite(z)
    if unknown.any():
        removed[unknown] = z[unknown] - _harmonic(z, unknown)
    return subtract(z, removed)


@operation("remove-scars")
@wraps(mark_scars)
def _fill_scars(z: Array, chosen: Array, **how: Any) -> Levelled:
    return remove_scars(z, scars=mark_scars(z, mask=chosen, masking="include", **how))


def _prominence(z: Array, max_width_px: int) -> Array:
    """Return, for each pixel, the largest prominence of the ridges that contain it and are at most
    ``max_width_px`` rows wide. In each column, the prominence of a ridge is its lowest height minus the
    height of the pixel directly above or below the ridge, whichever is higher.
    """
    ny = z.shape[0]
    prominence = np.zeros_like(z)
    for width in range(1, min(max_width_px, ny - 2) + 1):
        count = ny - width - 1
        ridge = np.min([z[1 + k : 1 + k + count] for k in range(width)], axis=0)
        gain = ridge - np.maximum(z[:count], z[width + 1 :])
        for k in range(width):
            part = prominence[1 + k : 1 + k + count]
            np.fmax(part, gain, out=part)
    return prominence


def _long_runs(prominence: Array, low: float, high: float, min_length_px: int) -> Array:
    along_row = np.array([[0, 0, 0], [1, 1, 1], [0, 0, 0]])
    labels, count = ndimage.label(prominence >= low, structure=along_row)
    lengths = np.bincount(labels.ravel(), minlength=count + 1)
    reaches = np.zeros(count + 1, dtype=bool)
    reaches[labels[prominence >= high]] = True
    kept = reaches & (lengths >= min_length_px)
    kept[0] = False
    return kept[labels]


def _harmonic(z: Array, unknown: Array) -> Array:
    """Solve Laplace's equation at the unknown pixels, and return their values in the order of ``z[unknown]``.
    The solution also fills unmeasured pixels (NaN), but their values are not returned.
    """
    from SurfaceTopography import Topography

    left_out = unknown | ~np.isfinite(z)
    areas, _ = ndimage.label(left_out)
    beside = ndimage.binary_dilation(~left_out)
    if set(np.unique(areas[unknown])) - set(np.unique(areas[beside & left_out])):
        raise InputError(
            "a marked area has no measured neighbour", wanted="marks with measured pixels around them"
        )
    known = Topography(np.ma.masked_array(z, left_out), z.shape)
    filled: Array = known.interpolate_undefined_data_with_harmonic_function().heights()
    return filled[unknown]
