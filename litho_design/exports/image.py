"""Layouts as grey images: grey is linear in height, one whole number of grey values per level."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_design.printers.layout import LayoutSettings

_UM_PER_CM = 1e4


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


def write_tiff(path: Path, levels: np.ndarray, layout: LayoutSettings) -> int:
    """A TIFF of two pages, 16-bit levels and float32 nominal heights in µm, with its resolution."""
    import tifffile

    per_cm = _UM_PER_CM / layout.pitch_um
    with tifffile.TiffWriter(path) as writer:
        for page in (levels.astype(np.uint16), (levels * layout.level_height_um).astype(np.float32)):
            writer.write(
                page, resolution=(per_cm, per_cm), resolutionunit="CENTIMETER", photometric="minisblack"
            )
    return 1


def read_image_levels(path: Path, grey_per_level: int) -> np.ndarray:
    """Levels uint8 (ny, nx) from an exported image.

    Raises:
        InputError: no image, or a grey value between two levels.
    """
    grey: np.ndarray | None
    if path.suffix in (".tif", ".tiff"):
        import tifffile

        grey = tifffile.imread(path, key=0)
    else:
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
