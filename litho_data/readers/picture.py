"""Read pictures with one grey value per pixel, from TIFF, PNG, BMP and NPY."""

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.readers.npy import load_array
from litho_data.readers.registry import PICTURE, detect_format, require_file
from litho_data.readers.tiff import open_tiff, require_upright, single_sample


def read_picture(path: str | Path, what: str = "picture") -> Array:
    """Read the stored numbers (ny, nx), row 0 on top; a colour image counts as grey if its colours are
    identical.

    Args:
        path: the file.
        what: what messages call the file.

    Raises:
        InputError: no such file, damaged, another format, a true colour image, numbers that are not finite.
    """
    file = require_file(path)
    kind = detect_format(file)
    readers = {"tiff": _tiff_pixels, "npy": load_array, PICTURE: _image_pixels}
    if kind not in readers:
        raise InputError(f"{what} {file}: format", got=kind, wanted="TIFF, PNG, BMP or NPY")
    pixels = single_sample(file, np.asarray(readers[kind](file)))
    if pixels.size == 0:
        raise InputError(f"{what} {file}: shape", got=pixels.shape, wanted="at least one pixel")
    if pixels.dtype.kind not in "uif" or not np.isfinite(pixels).all():
        raise InputError(f"{what} {file}: values", got=value_range(pixels), wanted="finite numbers")
    return pixels


def value_range(pixels: Array) -> str:
    """Describe the type and range of the numbers, for messages."""
    if pixels.dtype.kind not in "uif":
        return str(pixels.dtype)
    return f"{pixels.dtype} from {pixels.min():g} to {pixels.max():g}"


def _tiff_pixels(path: Path) -> Array:
    with open_tiff(path) as file:
        if len(file.pages) != 1:
            raise InputError(f"picture {path}: pages", got=len(file.pages), wanted="one image")
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
