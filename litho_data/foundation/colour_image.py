"""Small pictures of height maps as PNG bytes, in a hundredth of the time that a plot with axes takes."""

from __future__ import annotations

import io

import numpy as np

_COLOURS = 255
_GAP = 255  # the last entry of the palette, white


def coloured_png(image: np.ndarray, colours: str, low: float, high: float) -> bytes:
    """An image in one of matplotlib's colour maps, white where it is NaN.

    Args:
        image: (ny, nx), one value per pixel of the picture.
        colours: name of the colour map.
        low: value of its first colour, ``high``: of its last; what lies outside gets the nearest.
    """
    import matplotlib
    from PIL import Image

    shades = np.clip((image - low) / max(high - low, np.finfo(float).tiny), 0, 1) * (_COLOURS - 1)
    indices = np.where(np.isfinite(shades), np.rint(np.nan_to_num(shades)), _GAP).astype(np.uint8)
    palette = matplotlib.colormaps[colours](np.linspace(0, 1, _COLOURS), bytes=True)[:, :3]
    picture = Image.fromarray(indices)
    picture.putpalette([*palette.ravel().tolist(), 255, 255, 255])
    buffer = io.BytesIO()
    picture.save(buffer, format="png", compress_level=4)
    return buffer.getvalue()


def colour_bar_png(colours: str) -> bytes:
    """The colours from low to high, one pixel high, to be stretched."""
    return coloured_png(np.linspace(0, 1, _COLOURS)[None, :], colours, 0.0, 1.0)
