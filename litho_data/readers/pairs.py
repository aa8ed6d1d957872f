"""Read fields in the authors' pair format: 8-bit layouts and heights, cut into four quadrants.

A grey value stands for value / 255 · full scale. The format has no mask of valid pixels, no negative heights
and only 256 grey values, so it loses accuracy.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from litho_data.foundation import Array, InputError, Shape
from litho_data.readers.layout import read_layout

GREY_MAX = 255


def stitch_field(
    files: Sequence[Path], quadrants: Sequence[int], full_scale_um: Sequence[float], levels: int
) -> dict[str, Array]:
    """Join the quadrants of one field. ``files`` contains all layouts, followed by all heights, both in the
    order of ``quadrants``.

    Raises:
        InputError: a file is unreadable, quadrants have different sizes, or levels exceed the stated number.
    """
    images = [read_layout(path) for path in files]
    if len({image.shape for image in images}) != 1:
        raise InputError(
            f"sizes of {', '.join(path.name for path in files)}", got={image.shape for image in images}
        )
    mask = _join(images[: len(quadrants)], quadrants)
    if mask.max() >= levels:
        raise InputError(
            f"layout {files[0]}: highest level", got=int(mask.max()), wanted=f"at most {levels - 1}"
        )
    scaled = [
        (image.astype(float) / GREY_MAX * scale).astype(np.float32)
        for image, scale in zip(images[len(quadrants) :], full_scale_um, strict=True)
    ]
    height = _join(scaled, quadrants)
    arrays = {"mask_level": mask, "raw_height_um": height, "height_um": height}
    return {**arrays, "valid": np.ones(height.shape, dtype=bool), "scan_to_layout": np.eye(3)}


def quadrant_slices(quadrant: int, shape: Shape) -> tuple[slice, slice]:
    """Return the rows and columns of a quadrant in a field of this shape; quadrant 0 is the whole field."""
    if quadrant == 0:
        return slice(None), slice(None)
    ny, nx = shape[0] // 2, shape[1] // 2
    row, column = divmod(quadrant - 1, 2)
    return slice(row * ny, (row + 1) * ny), slice(column * nx, (column + 1) * nx)


def _join(parts: Sequence[Array], quadrants: Sequence[int]) -> Array:
    factor = 1 if len(parts) == 1 else 2
    shape = (parts[0].shape[0] * factor, parts[0].shape[1] * factor)
    field = np.empty(shape, dtype=parts[0].dtype)
    for part, quadrant in zip(parts, quadrants, strict=True):
        field[quadrant_slices(quadrant, shape)] = part
    return field
