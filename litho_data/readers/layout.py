"""Read layouts, i.e. the patterns that were sent to the printer, as integer levels. The file of a layout
contains the levels themselves or grey values that stand for levels.
"""

from pathlib import Path

import numpy as np

from litho_data.foundation import Array, InputError
from litho_data.readers.exported import export_of, exported_levels
from litho_data.readers.picture import read_picture, value_range
from litho_data.readers.registry import require_file

_WHITE = (255, 65535)


def read_layout(
    path: str | Path,
    *,
    grey_per_level: float | None = None,
    levels: int | None = None,
    average_px: int | None = None,
) -> Array:
    """Read the level numbers of a layout. The result is an array of shape (ny, nx), with row 0 at the top.

    The array is uint8, or uint16 for more than 256 levels. The file may be TIFF (with any compression that
    tifffile and imagecodecs support), PNG, BMP or NPY. A colour image is treated as greyscale if its channels
    are identical. A file that the design package exported, in any of its formats, is read with the help of
    its sidecar (the JSON file beside it).

    Args:
        path: the file.
        grey_per_level: difference between the grey values of two successive levels, if the file is a
            greyscale image of the layout.
        levels: number of levels of the layout; by default, up to 256 levels are accepted. If the file
            contains values too large for level numbers, it is read as a greyscale image in which white is the
            highest level. All its values must then be multiples of the same grey step.
        average_px: for an image with only two grey values, the side, in pixels, of the squares into which the
            image is divided. Each square becomes one pixel of the layout. Its level is the number of pixels
            in the square that have the lighter grey value. Pixels at the right and at the bottom that do not
            fill a square are cropped.

    Raises:
        InputError: the file does not exist, is damaged, has a format that is not supported, or is not grey;
            its values are not levels or multiples of the grey step; ``average_px`` is given but the image has
            more than two grey values or is smaller than a square; or the sidecar belongs to another file.
    """
    file = require_file(path)
    if says := export_of(file):
        return exported_levels(file, says)
    pixels = read_picture(file, "layout")
    if average_px is not None:
        return _averaged(file, pixels, average_px)
    step = grey_per_level or _white_step(pixels, levels)
    found, kind = np.rint(pixels / step), np.min_scalar_type((levels or 256) - 1)
    largest = np.iinfo(kind).max
    if (
        np.abs(pixels - found * step).max() > 0.5 * (step > 1)
        or not 0 <= found.min() <= found.max() <= largest
    ):
        wanted = f"integer levels from 0 to {largest}" if step == 1 else f"steps of {step:g} per level"
        raise InputError(f"layout {file}: values", got=value_range(pixels), wanted=wanted)
    return found.astype(kind)


def _averaged(file: Path, pixels: Array, side: int) -> Array:
    """Divide an image with two grey values into squares, and count the light pixels in each square. ``side``
    is the side of the squares in pixels.
    """
    ny, nx = (length // side for length in pixels.shape)
    greys = np.unique(pixels)
    if len(greys) > 2 or not ny * nx:
        wanted = f"two grey values, and at least {side} x {side} px"
        raise InputError(f"layout {file}", got=f"{len(greys)} grey values, {pixels.shape} px", wanted=wanted)
    light = (pixels == greys[-1]) & (greys[-1] > 0)
    squares = light[: ny * side, : nx * side].reshape(ny, side, nx, side)
    return squares.sum(axis=(1, 3)).astype(np.uint8)


def _white_step(pixels: Array, levels: int | None) -> float:
    """Return the difference between the grey values of successive levels. White is taken as the highest
    level. Return 1 if the file contains the level numbers themselves.
    """
    if levels is None or pixels.max() < levels:
        return 1.0
    for step in (one for white in _WHITE for one in (white / (levels - 1), float(white // (levels - 1)))):
        on_steps = np.abs(pixels - np.rint(pixels / step) * step).max() <= 0.5
        if step > 1 and on_steps and np.rint(pixels.max() / step) <= levels - 1:
            return step
    return 1.0
