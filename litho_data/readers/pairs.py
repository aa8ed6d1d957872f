"""Read printed fields in the format that the authors of the PBL paper use. Each field is stored as a pair of
8-bit images, one of the layout and one of the heights. A field may also be cut into four quadrants, with one
pair of images for each.

In an image of heights, the height of a pixel is its grey value, divided by 255 and multiplied by the full
scale. The format cannot store negative heights, and it rounds heights to 256 values. The authors' files have
no mask of valid pixels. This project adds a mask as a third image, in which pixels that were not measured are
black.
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
    """Join the quadrants of one field, and return the arrays of the field, keyed by name.

    Args:
        files: the images of the layout, then the images of the heights, then the masks of valid pixels, if
            there are any. Each of these groups has one image per quadrant, in the order of ``quadrants``.
        quadrants: the numbers of the quadrants, 1 to 4, or only 0 for an undivided field.
        full_scale_um: for each image of heights, the height that grey value 255 stands for.
        levels: number of levels that the layout may have.

    Raises:
        InputError: a file is unreadable, the images have different sizes, or a layout contains a level that
            exceeds ``levels - 1``.
    """
    images, count = [read_layout(path) for path in files], len(quadrants)
    if len({image.shape for image in images}) != 1:
        raise InputError(
            f"sizes of {', '.join(path.name for path in files)}", got={image.shape for image in images}
        )
    mask = _join(images[:count], quadrants)
    if mask.max() >= levels:
        raise InputError(
            f"layout {files[0]}: highest level", got=int(mask.max()), wanted=f"at most {levels - 1}"
        )
    scaled = [
        (image.astype(float) / GREY_MAX * scale).astype(np.float32)
        for image, scale in zip(images[count : 2 * count], full_scale_um, strict=True)
    ]
    seen = images[2 * count :] or [np.ones_like(image) for image in scaled]
    valid = _join(seen, quadrants) > 0
    height = np.where(valid, _join(scaled, quadrants), np.float32(np.nan))
    arrays = {"mask_level": mask, "raw_height_um": height, "height_um": height}
    return {**arrays, "valid": valid, "scan_to_layout": np.eye(3)}


def quadrant_slices(quadrant: int, shape: Shape) -> tuple[slice, slice]:
    """Return the slices of the rows and columns of a quadrant in a field of the given shape.

    Quadrants 1 to 4 are numbered row by row, and quadrant 0 is the whole field.
    """
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
