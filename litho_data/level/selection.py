"""Select the pixels that levelling operations use, and define the types of their results."""

from typing import Literal, NamedTuple

import numpy as np

from litho_data.foundation import Array, InputError

Masking = Literal["ignore", "exclude", "include"]


class Levelled(NamedTuple):
    """A levelled height map and the surface that levelling removed; ``height + removed`` is the input.

    Both maps are float64 arrays of shape (ny, nx) in the unit of the input. Pixels that are NaN in the input
    are NaN in ``height``. If a single operation made the result, ``removed`` has no NaN, and may be a
    read-only view if it is constant along an axis. If a recipe made it, ``removed`` is NaN where ``height``
    is NaN.
    """

    height: Array
    removed: Array


class MaskedLevelling(NamedTuple):
    """A levelled height map, the removed surface, and the mask of the features that were excluded from the
    fit.
    """

    levelled: Levelled
    mask: Array


def as_height(height: Array) -> Array:
    """Return the height map as a contiguous float64 array of shape (ny, nx).

    Raises:
        InputError: the map is not two-dimensional, or is smaller than 2 x 2 pixels.
    """
    z = np.ascontiguousarray(height, dtype=float)
    if z.ndim != 2 or min(z.shape) < 2:
        raise InputError("shape of the height map", got=z.shape, wanted="(ny, nx), at least 2 x 2")
    return z


def select(z: Array, mask: Array | None, masking: Masking) -> Array:
    """Return a bool array of shape (ny, nx) that is True at the pixels that an operation may use. ``masking``
    says whether the mask excludes pixels, selects them, or is ignored. Unmeasured pixels (NaN) are never
    used.

    Raises:
        InputError: the mask is not boolean or has another shape, or no pixel is left.
    """
    chosen = np.isfinite(z)
    if mask is not None and masking != "ignore":
        if mask.dtype != np.bool_ or mask.shape != z.shape:
            raise InputError("mask", got=f"{mask.dtype} {mask.shape}", wanted=f"bool {z.shape}")
        chosen &= ~mask if masking == "exclude" else mask
    if not chosen.any():
        raise InputError("no pixel is left for levelling", wanted="a mask that leaves measured pixels")
    return chosen


def subtract(z: Array, removed: Array) -> Levelled:
    """Subtract a surface from a height map, and return both maps."""
    return Levelled(z - removed, removed)
