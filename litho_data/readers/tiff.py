"""TIFF images: every page is a channel; values stay as stored."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import is_length, um_per
from litho_data.readers.confined import confined
from litho_data.readers.reader import Channel, Loaded, Reader, foreign_parser

if TYPE_CHECKING:
    from tifffile import TiffFile

_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_XRESOLUTION, _YRESOLUTION = 282, 283
_OME_SIZES = ("PhysicalSizeY", "PhysicalSizeX")
_JPK_FILE_FORMAT_VERSION = 0x8000


def read_channels(path: Path) -> list[Channel]:
    """One channel per page; RGB pages count as one channel if their samples are identical.

    The size of a pixel is taken from OME metadata, or from the resolution tags if ImageJ names their
    unit; otherwise these usually describe paper, not the sample.

    Raises:
        InputError: damaged file, or pages that are not two-dimensional images.
    """
    with open_tiff(path) as file:
        imagej = file.imagej_metadata or {}
        ome_um = _ome_pitch_um(file.ome_metadata or "")
        return [_channel(path, index, page, imagej, ome_um) for index, page in enumerate(file.pages)]


@contextmanager
def open_tiff(path: Path) -> Iterator[TiffFile]:
    """A TIFF file, open; any error of a damaged one becomes an InputError."""
    import tifffile

    with foreign_parser(path, "TIFF"), tifffile.TiffFile(path) as file:
        yield file


def _channel(
    path: Path, index: int, page: Any, imagej: dict[str, Any], ome_um: tuple[float, float] | None
) -> Channel:
    samples = page.samplesperpixel
    if page.ndim not in (2, 3) or (page.ndim == 3 and page.shape[-1] != samples):
        raise InputError(f"{path} page {index}: shape", got=page.shape, wanted="a two-dimensional image")
    shape = (int(page.shape[0]), int(page.shape[1]))
    dtype = np.dtype(page.dtype)
    if dtype.kind not in "uif":
        raise InputError(
            f"{path} page {index}: type of the values", got=dtype, wanted="integers or real numbers"
        )
    return Channel(
        name=f"page {index}",
        shape=shape,
        unit=None,
        size_um=(shape[0] * ome_um[0], shape[1] * ome_um[1]) if ome_um else _size_um(page, imagej, shape),
        load=partial(_load, path, index),
        full_scale=float(np.iinfo(dtype).max) if dtype.kind in "ui" else None,
        header={str(key): str(value) for key, value in imagej.items()}
        | ({"ImageDescription": str(page.description)} if page.description else {}),
    )


def _ome_pitch_um(text: str) -> tuple[float, float] | None:
    """(y, x) of the only image in OME metadata; its lengths are in µm unless it names another unit."""
    images = re.findall(r"<(?:\w+:)?Pixels\s[^>]*", text)
    if len(images) != 1:
        return None
    says = dict(re.findall(r'(PhysicalSize[XY](?:Unit)?)\s*=\s*"([^"]*)"', images[0]))
    try:
        pitch = [float(says[key]) * um_per(says.get(f"{key}Unit", "µm")) for key in _OME_SIZES]
    except (KeyError, ValueError):  # not stated, no number, or in pixels
        return None
    return (pitch[0], pitch[1]) if all(0 < one < np.inf for one in pitch) else None


def _size_um(page: Any, imagej: dict[str, Any], shape: tuple[int, int]) -> tuple[float, float] | None:
    unit = str(imagej.get("unit", "")).replace("\\u00B5", "µ")
    if not is_length(unit) or _XRESOLUTION not in page.tags or _YRESOLUTION not in page.tags:
        return None
    pixels_per_unit = [page.tags[code].value for code in (_YRESOLUTION, _XRESOLUTION)]
    if any(numerator == 0 or denominator == 0 for numerator, denominator in pixels_per_unit):
        return None
    pitch = [denominator / numerator * um_per(unit) for numerator, denominator in pixels_per_unit]
    return shape[0] * pitch[0], shape[1] * pitch[1]


def _load(path: Path, index: int) -> Loaded:
    with open_tiff(path) as file:
        return single_sample(path, file.pages[index].asarray()), None


def single_sample(path: Path, pixels: np.ndarray) -> np.ndarray:
    """(ny, nx) from (ny, nx) or from (ny, nx, 3 or 4) whose colours are identical.

    Raises:
        InputError: the colours differ, so a pixel has no single value.
    """
    if pixels.ndim == 3 and pixels.shape[2] in (1, 3, 4):
        colours = pixels[..., :3]
        if (colours == colours[..., :1]).all():
            return pixels[..., 0]
        raise InputError(
            f"{path} is a colour image", wanted="a grey image", hint="the colours of a pixel differ"
        )
    if pixels.ndim != 2:
        raise InputError(f"{path}: shape", got=pixels.shape, wanted="a two-dimensional image")
    return pixels


def _recognises(path: Path, head: bytes) -> bool:
    return head.startswith(_MAGIC) and not _is_jpk(path)


def _is_jpk(path: Path) -> bool:
    """Whether a TIFF is a JPK file: its first page then carries JPK's private tags."""
    try:
        with open_tiff(path) as file:
            return _JPK_FILE_FORMAT_VERSION in file.pages.first.tags
    except InputError:  # the reader that tries it next reports it
        return False


READER = Reader(
    "tiff", _recognises, confined(read_channels, ("tifffile", "imagecodecs")), self_describing=False
)
