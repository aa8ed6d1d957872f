"""Layouts: what was sent to the printer, as integer levels, from files of levels or pictures of them."""

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.readers.exported import export_of, exported_levels
from litho_data.readers.npy import load_array
from litho_data.readers.registry import PICTURE, detect_format, require_file
from litho_data.readers.tiff import open_tiff, require_upright, single_sample

_LARGEST_LEVEL = 255
_WHITE = (255, 65535)


def read_layout(path: str | Path, *, grey_per_level: float | None = None, levels: int | None = None) -> Array:
    """Levels of a layout, uint8 (ny, nx), row 0 on top.

    TIFF (any compression of tifffile and imagecodecs), PNG, BMP and NPY; a colour image counts as
    grey if its colours are identical. A file that the design package exported, of any of its formats, is read
    by the sidecar beside it.

    Args:
        path: the file.
        grey_per_level: step of the grey values from level to level, if the file is a picture of the layout.
        levels: how many there are. A picture whose values go beyond them is then taken for one whose white is
            the highest level, if all its values are steps of it.

    Raises:
        InputError: no such file, damaged, another format, a true colour image, values that are no levels or
            no steps of grey, a sidecar of another file.
    """
    file = require_file(path)
    if says := export_of(file):
        return exported_levels(file, says)
    kind = detect_format(file)
    readers = {"tiff": _tiff_pixels, "npy": load_array, PICTURE: _image_pixels}
    if kind not in readers:
        raise InputError(f"layout {file}: format", got=kind, wanted="TIFF, PNG, BMP or NPY")
    pixels = single_sample(file, np.asarray(readers[kind](file)))
    if pixels.size == 0:
        raise InputError(f"layout {file}: shape", got=pixels.shape, wanted="at least one pixel")
    if pixels.dtype.kind not in "uif" or not np.isfinite(pixels).all():
        raise InputError(f"layout {file}: values", got=_range(pixels), wanted="integer levels from 0 to 255")
    step = grey_per_level or _white_step(pixels, levels)
    found = np.rint(pixels / step)
    if (
        np.abs(pixels - found * step).max() > 0.5 * (step > 1)
        or not 0 <= found.min() <= found.max() <= _LARGEST_LEVEL
    ):
        wanted = "integer levels from 0 to 255" if step == 1 else f"steps of {step:g} per level"
        raise InputError(f"layout {file}: values", got=_range(pixels), wanted=wanted)
    return found.astype(np.uint8)


def _white_step(pixels: Array, levels: int | None) -> float:
    """The step of a picture whose white is the highest level; 1 for levels."""
    if levels is None or pixels.max() < levels:
        return 1.0
    for step in (one for white in _WHITE for one in (white / (levels - 1), float(white // (levels - 1)))):
        on_steps = np.abs(pixels - np.rint(pixels / step) * step).max() <= 0.5
        if step > 1 and on_steps and np.rint(pixels.max() / step) <= levels - 1:
            return step
    return 1.0


def _tiff_pixels(path: Path) -> Array:
    with open_tiff(path) as file:
        if len(file.pages) != 1:
            raise InputError(f"layout {path}: pages", got=len(file.pages), wanted="one image")
        require_upright(path, file.pages.first)
        return file.pages.first.asarray()


def _image_pixels(path: Path) -> Array:
    import cv2

    try:
        pixels = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"cannot read {path} as an image", got=str(error)) from error
    if pixels is None:
        raise InputError(f"cannot read {path} as an image", wanted="an undamaged PNG or BMP")
    return pixels


def _range(pixels: Array) -> str:
    if pixels.dtype.kind not in "uif":
        return str(pixels.dtype)
    return f"{pixels.dtype} from {pixels.min():g} to {pixels.max():g}"
