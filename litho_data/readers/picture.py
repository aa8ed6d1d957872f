"""Read pictures that have one grey value per pixel, from TIFF, PNG, BMP and NPY files."""

from pathlib import Path

import numpy as np

from litho_data.foundation import Array, InputError, about
from litho_data.readers.npy import load_array
from litho_data.readers.reader import foreign_parser
from litho_data.readers.registry import PICTURE, detect_format, require_file
from litho_data.readers.tiff import open_tiff, require_upright, single_sample


def read_picture(path: str | Path, what: str = "picture") -> Array:
    """Return the stored numbers of a picture as an array of shape (ny, nx) with row 0 at the top.

    A colour image is treated as greyscale if its channels are identical.

    Args:
        path: the file.
        what: the word that messages use for the file, such as "layout".

    Raises:
        InputError: the file does not exist, is damaged, has a format that is not supported, is not grey, or
            contains numbers that are not finite.
    """
    file = require_file(path)
    with about(f"{what} {file}"):
        kind = detect_format(file)
        readers = {"tiff": _tiff_pixels, "npy": load_array, PICTURE: _image_pixels}
        if kind not in readers:
            raise InputError("format", got=kind, wanted="TIFF, PNG, BMP or NPY")
        pixels = single_sample(np.asarray(readers[kind](file)))
        if pixels.size == 0:
            raise InputError("shape", got=pixels.shape, wanted="at least one pixel")
        if pixels.dtype.kind not in "uif" or not np.isfinite(pixels).all():
            raise InputError("values", got=value_range(pixels), wanted="finite numbers")
    return pixels


def value_range(pixels: Array) -> str:
    """Return a text for messages that states the type and the range of a picture's numbers."""
    if pixels.dtype.kind not in "uif":
        return str(pixels.dtype)
    return f"{pixels.dtype} from {pixels.min():g} to {pixels.max():g}"


def _tiff_pixels(path: Path) -> Array:
    with open_tiff(path) as file:
        if len(file.pages) != 1:
            raise InputError("pages", got=len(file.pages), wanted="one image")
        require_upright(file.pages.first)
        return file.pages.first.asarray()


def _image_pixels(path: Path) -> Array:
    import cv2

    with foreign_parser("an image"):
        pixels = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError("cannot be read as an image", wanted="an undamaged PNG or BMP")
    return pixels
