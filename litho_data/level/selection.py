"""Selection of pixels and result type for all levelling operations."""

from typing import Literal, NamedTuple

import numpy as np

from litho_data.foundation import Array, InputError

Masking = Literal["ignore", "exclude", "include"]


class Levelled(NamedTuple):
    """A levelled map and the surface removed; ``height + removed`` is the input.

    Both are float64 (ny, nx) in the unit of the input. NaNs of the input stay NaN in ``height``;
    ``removed`` is a number everywhere, and may be a read-only view where it is constant along an axis.
    """

    height: Array
    removed: Array


class MaskedLevelling(NamedTuple):
    """A levelled map, and the features that were left out."""

    levelled: Levelled
    mask: Array


def as_height(height: Array) -> Array:
    """The map as contiguous float64 (ny, nx).

    Raises:
        InputError: not two-dimensional or below 2 x 2 pixels.
    """
    z = np.ascontiguousarray(height, dtype=float)
    if z.ndim != 2 or min(z.shape) < 2:
        raise InputError("shape of the height map", got=z.shape, wanted="(ny, nx), at least 2 x 2")
    return z


def select(z: Array, mask: Array | None, masking: Masking) -> Array:
    """Pixels that an operation may use, bool (ny, nx); never those that were not measured (NaN).

    Raises:
        InputError: a mask that is not boolean or has another shape, or a selection without any pixel.
    """
    chosen = np.isfinite(z)
    if mask is not None and masking != "ignore":
        if mask.dtype != np.bool_ or mask.shape != z.shape:
            raise InputError("mask", got=f"{mask.dtype} {mask.shape}", wanted=f"bool {z.shape}")
        chosen &= ~mask if masking == "exclude" else mask
    if not chosen.any():
        raise InputError("no pixel is left to level with", wanted="a mask that leaves measured pixels")
    return chosen


def subtract(z: Array, removed: Array) -> Levelled:
    """The map minus the surface."""
    return Levelled(z - removed, removed)
