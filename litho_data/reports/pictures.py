"""Draw the figures and maps of reports in colours that suit light and dark screens."""

from __future__ import annotations

import base64
import html
import io
import re
import zlib
from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation import Array, table_beside

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_OWN = table_beside(__file__, "colours.toml")
LIGHT, DARK = _OWN["light"], _OWN["dark"]
# Names of the colours in a figure that change with the light or dark mode of the screen.
_OF_SCREEN = ("ink", "paper", "soft", "accent")
_FURTHER_COLOURS = ("#cc4f8f", "#0e8f86", "#9a63c9", "#7d8a1d", "#b56b4c", "#a87400")
_PICTURE_DPI = 110
_COLOURS = 255
# Side length of a map that a notebook shows.
_NOTEBOOK_PX = 220
_GAP = 255  # the last entry of the palette, which is transparent and used for NaN


def model_colour(name: str) -> str:
    """Return the colour of a model, which is the same on every page.

    The project's own models have fixed colours. For any other model, the colour is derived from its name.
    """
    known = _OWN["models"].get(name)
    return known or _FURTHER_COLOURS[zlib.crc32(name.encode()) % len(_FURTHER_COLOURS)]


def new_figure(width_inch: float, height_inch: float) -> Figure:
    """Make a figure without pyplot's global state, so that reports neither leak memory nor need a display."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inch, height_inch), layout="constrained")
    FigureCanvasSVG(figure)
    return figure


def svg_address(figure: Figure) -> str:
    """Return a figure as the data URL of an SVG. Its ``LIGHT`` colours follow the light or dark mode of the
    screen.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.StringIO()
    figure.dpi = _PICTURE_DPI
    # savefig is not used, because it lays out and draws everything twice.
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    for word in _OF_SCREEN:
        text = re.sub(rf"{LIGHT[word]}\b", f"var(--{word})", text)
    text = re.sub(r"#000000\b", "var(--ink)", text)
    light, dark = ("; ".join(f"--{word}:{own[word]}" for word in _OF_SCREEN) for own in (LIGHT, DARK))
    style = f"svg {{ {light}; fill:var(--ink) }} @media (prefers-color-scheme: dark) {{ svg {{ {dark} }} }}"
    text = text.replace("</style>", f"{style}</style>", 1)
    return f"data:image/svg+xml;base64,{_base64(text.encode())}"


def coloured_png(image: Array, colours: str, low: float, high: float) -> str:
    """Return an image as the data URL of a PNG picture. Its values are coloured by a matplotlib colour map,
    and NaN is transparent.

    Args:
        image: array of shape (ny, nx) with one value for each pixel of the picture.
        colours: name of the colour map.
        low, high: values that get the first and the last colour of the map. Values below ``low`` get the
            first colour, and values above ``high`` the last.
    """
    import matplotlib
    from PIL import Image

    shades = np.clip((image - low) / max(high - low, np.finfo(float).tiny), 0, 1) * (_COLOURS - 1)
    indices = np.where(np.isfinite(shades), np.rint(np.nan_to_num(shades)), _GAP).astype(np.uint8)
    palette = matplotlib.colormaps[colours](np.linspace(0, 1, _COLOURS), bytes=True)[:, :3]
    picture = Image.fromarray(indices)
    picture.putpalette([*palette.ravel().tolist(), 255, 255, 255])
    buffer = io.BytesIO()
    picture.save(buffer, format="png", compress_level=4, transparency=_GAP)
    return f"data:image/png;base64,{_base64(buffer.getvalue())}"


def limits(image: Array) -> tuple[float, float]:
    """Return the 0.5 % and 99.5 % quantiles of an image, as limits of a colour scale that a few outliers do
    not affect.
    """
    low, high = np.nanpercentile(image, (0.5, 99.5))
    return float(low), float(high)


def thumbnail(image: Array, side_px: int = 180) -> Array:
    """Keep every n-th row and column of an image, so that no side of the result exceeds ``side_px``
    pixels.
    """
    step = max(1, -(-max(image.shape) // side_px))
    return image[::step, ::step]


def colour_bar_png(colours: str) -> str:
    """Return a picture of a colour map, from its first to its last colour, as a data URL. The picture is one
    pixel high; pages stretch it.
    """
    return coloured_png(np.linspace(0, 1, _COLOURS)[None, :], colours, 0.0, 1.0)


def shown_html(line: str, **images: Array) -> str:
    """Return the HTML that a notebook shows for an object: its ``repr``, then its maps with their ranges.

    Args:
        line: the ``repr`` of the object, on one line.
        images: maps by name, each an array of shape (ny, nx).
    """
    figures = []
    for name, values in images.items():
        image = np.where(np.isfinite(values), values, np.nan)
        low, high = float(np.nanmin(image)), float(np.nanmax(image))
        png = coloured_png(thumbnail(image, _NOTEBOOK_PX), "viridis", low, high)
        caption = f"{name.replace('_um', ', µm').replace('_', ' ')}: {low:.3g} … {high:.3g}"
        figures.append(
            f'<figure style="display:inline-block;margin:.3em"><img src="{png}" alt="{name}" '
            f'style="width:{_NOTEBOOK_PX}px"><figcaption>{caption}</figcaption></figure>'
        )
    return f"<p>{html.escape(line)}</p>{''.join(figures)}"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
