"""Draw target height maps, or read them from a file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

import numpy as np

from litho_data.foundation.errors import InputError, unknown_name
from litho_data.readers.reader import foreign_parser
from litho_design.images.targets import TargetRecord, read_image
from litho_design.printers.layout import LayoutSettings

DrawnRelief = Literal["lens", "blaze", "staircase"]
_PERIODS, _STEPS = 4, 6


def load_relief(
    source: str | Path | np.ndarray, layout: LayoutSettings, height_um: float
) -> tuple[np.ndarray, TargetRecord]:
    """Return a target height map and its record. The map is a float32 array of shape (size, size), in µm.

    Args:
        source: a drawing, a greyscale image, or heights in µm (a float TIFF or an array). The drawings are
            ``height_um`` high: lens (a spherical cap), blaze (four periods of a sawtooth along x) and
            staircase (six steps along x). The brightest value of an image becomes the height ``height_um``.

    Raises:
        InputError: the source is not a drawing, a readable file or an array; or the heights have another
            shape or are not numbers.
    """
    size = layout.size_px
    if isinstance(source, np.ndarray):
        return _checked(source, size), TargetRecord.of_array("array", _checked(source, size), "um")
    name, path = str(source), Path(source)
    if name in get_args(DrawnRelief):
        drawn = (height_um * _draw(name, size)).astype(np.float32)
        return drawn, TargetRecord.of_array(name, drawn, "um")
    if not path.is_file():
        raise unknown_name("relief", name, get_args(DrawnRelief), also="a picture, or a float TIFF in µm")
    notes: list[str] = []
    heights = _float_tiff(path)
    if heights is None:
        grey, notes = read_image(path, size, "relief")
        heights = height_um * grey
        notes.append(f"its brightest value is {height_um:g} µm")
    return _checked(heights, size), TargetRecord.of_file(path, notes)


def print_off_um(printed_um: np.ndarray, predicted_um: np.ndarray, blur_px: float) -> np.ndarray:
    """Return the deviation of a print from its prediction, blurred and without its mean. The result is a
    float32 array of shape (size, size), in µm.

    The blur removes the roughness, which differs from print to print and therefore cannot be corrected.
    """
    from scipy.ndimage import gaussian_filter

    off = gaussian_filter(printed_um.astype(np.float64) - predicted_um, blur_px)
    return (off - off.mean()).astype(np.float32)


def _float_tiff(path: Path) -> np.ndarray | None:
    """Return the heights, in µm, that a TIFF of floating-point numbers contains. Return None for any other
    file.

    Raises:
        InputError: the file has the name of a TIFF but is not readable as a TIFF.
    """
    if path.suffix.lower() not in (".tif", ".tiff"):
        return None
    import tifffile

    with foreign_parser(f"TIFF {path}"):
        heights = tifffile.imread(path)
    return heights if np.issubdtype(heights.dtype, np.floating) else None


def _draw(name: str, size_px: int) -> np.ndarray:
    """Draw a relief of shape (size, size) with values in [0, 1]."""
    x = (np.arange(size_px) + 0.5) / size_px
    if name == "blaze":
        return np.tile(_PERIODS * x % 1, (size_px, 1))
    if name == "staircase":
        return np.tile(np.floor(_STEPS * x) / (_STEPS - 1), (size_px, 1))
    radius = np.hypot(x[:, None] - 0.5, x[None, :] - 0.5) / 0.45
    return np.clip(1 - radius**2, 0, None)


def _checked(heights: np.ndarray, size_px: int) -> np.ndarray:
    found = np.ascontiguousarray(heights, np.float32)
    if found.shape != (size_px, size_px):
        raise InputError(
            "relief", got=f"{found.shape} px", wanted=f"({size_px}, {size_px}) px, the size of the element"
        )
    if not np.isfinite(found).all() or np.ptp(found) == 0:
        raise InputError(
            "relief",
            got="heights that are all equal or not numbers",
            wanted="finite heights in µm that are not all equal",
        )
    return found
