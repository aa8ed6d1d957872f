"""Layouts as grey images: grey is linear in height, one whole number of grey values per level."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_design.large.rows import LevelRows, bands_of
from litho_design.printers.layout import LayoutSettings

_UM_PER_CM = 1e4
_STRIP_PX = 64
# Offsets in a TIFF have 32 bits; beyond that, with room for its tags, it is a BigTIFF.
_CLASSIC_BYTES = 2**32 - 2**24


def grey_step(layout: LayoutSettings, bits: int) -> int:
    """Grey values per level, the most that ``bits`` allow."""
    return (2**bits - 1) // (layout.levels - 1)


def write_png16(path: Path, levels: np.ndarray, layout: LayoutSettings) -> int:
    """A 16-bit grey PNG; returns the grey values per level."""
    return _write_encoded(path, ".png", levels, grey_step(layout, 16), np.uint16)


def write_bmp(path: Path, levels: np.ndarray, layout: LayoutSettings) -> int:
    """An 8-bit grey BMP, and beside it a CSV of grey against height; returns the grey values per level."""
    step = _write_encoded(path, ".bmp", levels, grey_step(layout, 8), np.uint8)
    rows = [f"{level * step},{level * layout.level_height_um:.9g}" for level in range(layout.levels)]
    path.with_suffix(".csv").write_text("grey,height_um\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return step


def write_tiff(path: Path, levels: LevelRows, layout: LayoutSettings) -> int:
    """A TIFF of two pages, 16-bit levels and float32 nominal heights in µm, with its resolution.

    Written strip by strip; where a TIFF cannot hold them they are a BigTIFF, compressed by deflate.
    """
    import tifffile

    per_cm, shape = _UM_PER_CM / layout.pitch_um, (levels.shape[0], levels.shape[1])
    big = shape[0] * shape[1] * (2 + 4) > _CLASSIC_BYTES

    def strips(scale: float, kind: np.dtype[Any]) -> Iterator[bytes]:
        for rows in bands_of(levels, _STRIP_PX):
            found = (levels[rows] * scale).astype(kind).tobytes()
            yield zlib.compress(found, 1) if big else found

    with tifffile.TiffWriter(path, bigtiff=big, byteorder="<") as writer:
        for scale, kind in ((1.0, np.dtype("<u2")), (layout.level_height_um, np.dtype("<f4"))):
            writer.write(
                strips(scale, kind), shape=shape, dtype=kind, rowsperstrip=_STRIP_PX,
                compression="zlib" if big else None, resolution=(per_cm, per_cm),
                resolutionunit="CENTIMETER", photometric="minisblack",
            )  # fmt: skip
    return 1


class TiffRows:
    """The levels of a file of ``write_tiff``, uint8; of the file only the strips asked for are read."""

    def __init__(self, path: Path):
        import tifffile
        import zarr

        self._page: Any = zarr.open_array(tifffile.imread(path, key=0, aszarr=True), mode="r")
        self.shape: tuple[int, ...] = self._page.shape

    def __getitem__(self, rows: slice) -> np.ndarray:
        found: np.ndarray = self._page[rows].astype(np.uint8)
        return found


def read_image_levels(path: Path, grey_per_level: int) -> np.ndarray:
    """Levels uint8 (ny, nx) from an exported PNG or BMP.

    Raises:
        InputError: no image, or a grey value between two levels.
    """
    import cv2

    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if grey is None or (grey % grey_per_level).any():
        raise InputError(
            f"image {path}", got="grey values between levels", wanted=f"multiples of {grey_per_level}"
        )
    return (grey // grey_per_level).astype(np.uint8)


def read_published_bmp(path: Path) -> np.ndarray:
    """Levels uint8 of the one published hologram mask, whose grey value is level + 10."""
    import cv2

    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None or grey.min() < 10:
        raise InputError(f"published mask {path}", wanted="an 8-bit image of grey level + 10")
    return (grey - 10).astype(np.uint8)


def _write_encoded(path: Path, suffix: str, levels: np.ndarray, step: int, dtype: type) -> int:
    import cv2

    if step < 1:
        raise InputError(f"{suffix} export", got="more levels than grey values", wanted="png16 or tiff")
    path.write_bytes(cv2.imencode(suffix, (levels.astype(np.uint32) * step).astype(dtype))[1].tobytes())
    return step
