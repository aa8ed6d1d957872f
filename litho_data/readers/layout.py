"""Layouts: what was sent to the printer, as integer levels."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.readers.npy import load_array
from litho_data.readers.registry import detect_format, require_file
from litho_data.readers.tiff import open_tiff, single_sample

_LARGEST_LEVEL = 255


def read_layout(path: str | Path) -> np.ndarray:
    """Levels of a layout, uint8 (ny, nx), row 0 on top.

    TIFF (any compression of tifffile and imagecodecs), PNG, BMP and NPY; a colour image counts as
    grey if its colours are identical.

    Raises:
        InputError: no such file, damaged, another format, a true colour image, or values that are
            not integers from 0 to 255.
    """
    file = require_file(path)
    readers = {"tiff": _tiff_pixels, "npy": load_array, "image": _image_pixels}
    kind = detect_format(file)
    if kind not in readers:
        raise InputError(f"layout {file}: format", got=kind, wanted="TIFF, PNG, BMP or NPY")
    pixels = single_sample(file, np.asarray(readers[kind](file)))
    if pixels.size == 0:
        raise InputError(f"layout {file}: shape", got=pixels.shape, wanted="at least one pixel")
    if not _are_levels(pixels):
        raise InputError(f"layout {file}: values", got=_range(pixels), wanted="integer levels from 0 to 255")
    return pixels.astype(np.uint8)


def _are_levels(pixels: np.ndarray) -> bool:
    if pixels.dtype.kind not in "uif" or not np.isfinite(pixels).all():
        return False
    in_range = pixels.min() >= 0 and pixels.max() <= _LARGEST_LEVEL
    return bool(in_range and np.array_equal(pixels, np.floor(pixels)))


def _tiff_pixels(path: Path) -> np.ndarray:
    with open_tiff(path) as file:
        if len(file.pages) != 1:
            raise InputError(f"layout {path}: pages", got=len(file.pages), wanted="one image")
        return file.pages.first.asarray()


def _image_pixels(path: Path) -> np.ndarray:
    import cv2

    try:
        pixels = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"cannot read {path} as an image", got=str(error)) from error
    if pixels is None:
        raise InputError(f"cannot read {path} as an image", wanted="an undamaged PNG or BMP")
    return pixels


def _range(pixels: np.ndarray) -> str:
    if pixels.dtype.kind not in "uif":
        return str(pixels.dtype)
    return f"{pixels.dtype} from {pixels.min():g} to {pixels.max():g}"
