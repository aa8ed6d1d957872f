"""Write layouts as images whose grey values are linear in height or follow a dose curve."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_design.exports.rows import LevelRows, bands_of
from litho_design.printers.layout import LayoutSettings

_UM_PER_CM = 1e4
_STRIP_PX = 64
# If the pages need more bytes than this limit, the file is written as a BigTIFF, because offsets in a classic
# TIFF have 32 bits. The limit leaves room for the tags.
_CLASSIC_BYTES = 2**32 - 2**24


def linear_greys(layout: LayoutSettings, bits: int) -> list[int]:
    """Return the grey value of each level. The grey values are linear in height, with the largest step that
    ``bits`` bits per pixel allow.

    Raises:
        InputError: there are more levels than grey values.
    """
    step = (2**bits - 1) // (layout.levels - 1)
    if step < 1:
        raise InputError("grey export", got="more levels than grey values", wanted="png16 or tiff")
    return [level * step for level in range(layout.levels)]


def measured_greys(layout: LayoutSettings, bits: int, curve: str | Path) -> list[int]:
    """Return the grey value of each level, such that the measured heights of these grey values equal the
    heights of the levels, apart from an offset common to all levels.

    Args:
        curve: CSV with the columns ``grey`` and ``height_um``, for example from a dose matrix. The values in
            both columns must increase from row to row.

    Raises:
        InputError: the file is not a table with these columns, the height of a level is outside the measured
            range, or two levels would have the same grey value.
    """
    try:
        table = np.atleast_1d(np.genfromtxt(curve, delimiter=",", names=True, dtype=float))
        grey, height_um = table["grey"], table["height_um"]
        rising = len(grey) > 1 and all((np.diff(one) > 0).all() for one in (grey, height_um))
    except (OSError, ValueError, IndexError):
        rising = False
    if not rising:
        wanted = "a CSV with the columns grey and height_um, both increasing"
        raise InputError("dose curve", got=str(curve), wanted=wanted)
    heights = height_um[0] + np.arange(layout.levels) * layout.level_height_um
    found = np.rint(np.interp(heights, height_um, grey)).astype(int).tolist()
    if heights[-1] > height_um[-1] + 1e-9 or len(set(found)) < layout.levels:
        got = (
            f"a height range of {np.ptp(height_um):.3g} µm, but levels over {heights[-1] - heights[0]:.3g} µm"
        )
        raise InputError("dose curve", got=got, wanted="a curve with a different grey value for every level")
    if found[0] < 0 or found[-1] >= 2**bits:
        raise InputError("dose curve", got=f"grey {found[-1]}", wanted=f"0 to {2**bits - 1}")
    return found


def write_image(path: Path, levels: np.ndarray, greys: Sequence[int], level_height_um: float) -> None:
    """Write either a 16-bit greyscale PNG or an 8-bit BMP. With the BMP, also write a CSV that states the
    height of each grey value.
    """
    import cv2

    kind = np.uint8 if path.suffix == ".bmp" else np.uint16
    encoded = cv2.imencode(path.suffix, np.array(greys, kind)[levels])[1]
    path.write_bytes(encoded.tobytes())
    if path.suffix == ".bmp":
        rows = [f"{grey},{level * level_height_um:.9g}" for level, grey in enumerate(greys)]
        text = "grey,height_um\n" + "\n".join(rows) + "\n"
        path.with_suffix(".csv").write_text(text, encoding="utf-8")


def write_tiff(path: Path, levels: LevelRows, pitch_um: float, level_height_um: float) -> None:
    """Write a TIFF that states its resolution and has two pages: 16-bit levels, and float32 nominal heights
    in µm.

    The file is written strip by strip. If the pages are too large for a classic TIFF, the file is a BigTIFF
    with deflate compression.
    """
    import tifffile

    per_cm, shape = _UM_PER_CM / pitch_um, (levels.shape[0], levels.shape[1])
    big = shape[0] * shape[1] * (2 + 4) > _CLASSIC_BYTES

    def strips(scale: float, kind: np.dtype[Any]) -> Iterator[bytes]:
        for rows in bands_of(levels, _STRIP_PX):
            found = (levels[rows] * scale).astype(kind).tobytes()
            yield zlib.compress(found, 1) if big else found

    with tifffile.TiffWriter(path, bigtiff=big, byteorder="<") as writer:
        for scale, kind in ((1.0, np.dtype("<u2")), (level_height_um, np.dtype("<f4"))):
            writer.write(
                strips(scale, kind), shape=shape, dtype=kind, rowsperstrip=_STRIP_PX,
                compression="zlib" if big else None, resolution=(per_cm, per_cm),
                resolutionunit="CENTIMETER", photometric="minisblack",
            )  # fmt: skip
