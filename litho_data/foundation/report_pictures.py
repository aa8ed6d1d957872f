"""Pictures of reports: figures for wide and narrow screens, colours for light and dark ones."""

from __future__ import annotations

import base64
import html
import io
import re
import textwrap
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation.kinds import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend

LIGHT = {
    "paper": "#ffffff",
    "ink": "#1c2430",
    "soft": "#56616f",
    "line": "#dfe4ea",
    "band": "#f4f6f9",
    "accent": "#0b6aa2",
}
DARK = {
    "paper": "#13171d",
    "ink": "#e6e9ee",
    "soft": "#a7b1be",
    "line": "#343d49",
    "band": "#1d232b",
    "accent": "#6cb8ea",
}
# One colour a model, on every page; each stands out from both papers (3:1, tests/test_report.py).
_MODEL_COLOURS = {
    "identity": "#868d98",
    "none": "#868d98",
    "affine": "#a87400",
    "affine-mtf": "#b56b4c",
    "blur-table": "#7d8a1d",
    "linear": "#0e8f86",
    "physics": "#c8502f",
    "pbl": "#2f7fd0",
    "fno": "#9a63c9",
    "features": "#3a9142",
    "random-features": "#cc4f8f",
    "corrected": "#3a9142",
}
_FURTHER_COLOURS = ("#cc4f8f", "#0e8f86", "#9a63c9", "#7d8a1d", "#b56b4c", "#a87400")
# Width of a figure on a telephone: letters of 9 points are then 11 px high.
_NARROW_INCH = 4.2
_PICTURE_DPI = 110
_COLOURS = 255
# Side of a map in a notebook.
_NOTEBOOK_PX = 220
_GAP = 255  # the last entry of the palette, transparent


def model_colour(name: str) -> str:
    """The colour of a model on every page: fixed for those of the project, else drawn from its name."""
    known = _MODEL_COLOURS.get(name)
    return known or _FURTHER_COLOURS[zlib.crc32(name.encode()) % len(_FURTHER_COLOURS)]


def new_figure(width_inch: float, height_inch: float) -> Figure:
    """A figure outside pyplot's global state, so that reports never leak memory or need a display."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inch, height_inch), layout="constrained")
    FigureCanvasSVG(figure)
    return figure


def wide_and_narrow(figure: Figure) -> tuple[str, str]:
    """Data addresses of two SVGs: the figure as it is, and its panels one below the other for a telephone.

    Black and white become ink and paper, which change with the colours of the screen. The figure itself is
    rearranged on the way: it is of no use afterwards.
    """
    wide = _svg(figure)
    _stack(figure)
    return wide, _svg(figure)


def _svg(figure: Figure) -> str:
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.StringIO()
    figure.dpi = _PICTURE_DPI
    # Not savefig, which lays out and draws everything twice.
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    for word in ("ink", "paper"):
        text = re.sub(rf"{LIGHT[word]}\b", f"var(--{word})", text)
    text = re.sub(r"#000000\b", "var(--ink)", text)
    style = (
        f"svg {{ --ink:{LIGHT['ink']}; --paper:{LIGHT['paper']}; fill:var(--ink) }} "
        f"@media (prefers-color-scheme: dark) {{ svg {{ --ink:{DARK['ink']}; --paper:{DARK['paper']} }} }}"
    )
    text = text.replace("</style>", f"{style}</style>", 1)
    return f"data:image/svg+xml;base64,{_base64(text.encode())}"


def _stack(figure: Figure) -> None:
    """Give every panel the whole width; pictures, from three on, half of it. Scales go below."""
    from matplotlib.gridspec import GridSpec

    bars = [axes._colorbar for axes in figure.axes if hasattr(axes, "_colorbar")]
    panels = [axes for axes in figure.axes if not hasattr(axes, "_colorbar") and axes.get_subplotspec()]
    shown = [axes for axes in panels if axes.get_visible() and (axes.axison or axes.images)]
    for axes in set(panels) - set(shown):
        axes.remove()
    columns = 2 if len(shown) > 2 and all(axes.images for axes in shown) else 1
    rows = -(-len(shown) // columns)
    width = _NARROW_INCH / columns
    high = float(figure.get_size_inches()[1])
    heights = [_narrow_height(axes, width, high) for axes in shown]
    by_row = [max(heights[row * columns : (row + 1) * columns]) for row in range(rows)]
    under = _lay_down(figure, bars, columns)
    figure.set_size_inches(_NARROW_INCH, sum(by_row) + under + _unfold_words(figure, shown, columns))
    grid = GridSpec(rows, columns, figure=figure, height_ratios=by_row)
    for place, axes in enumerate(shown):
        axes.set_subplotspec(grid[place // columns, place % columns])
    if columns == 2 and (engine := figure.get_layout_engine()) is not None:
        # Pictures keep their shape: room for their titles is found only once they are near their places.
        for _ in range(3):
            engine.execute(figure)


def _narrow_height(axes: Axes, width: float, figure_height: float) -> float:
    """Height of a panel in a narrow figure: pictures are about square, names along y keep their distance."""
    if axes.images:
        return width * 1.08
    place = axes.get_subplotspec()
    assert place is not None
    before = figure_height / place.get_gridspec().nrows
    named = re.search("Fixed|Func|Category", type(axes.yaxis.get_major_formatter()).__name__)
    names = len(axes.get_yticks()) if named else 0
    return max(min(before, 0.8 * _NARROW_INCH), 0.6 * width, 0.22 * names)


def _lay_down(figure: Figure, bars: list[Any], columns: int) -> float:
    """Put the colour bars below their panels; returns the inches they need."""
    inches = 0.0
    for bar in bars:
        parents, label = bar.ax._colorbar_info["parents"], bar.ax.get_ylabel()
        picture = bar.mappable
        bar.remove()
        new = figure.colorbar(picture, ax=parents, location="bottom", label=label, aspect=35, pad=0.02)
        new.ax.locator_params(nbins=5 if len(parents) > 1 else 6 - columns)
        inches += 0.55 / (columns if len(parents) == 1 else 1)
    return inches


def _unfold_words(figure: Figure, shown: list[Axes], columns: int) -> float:
    """Wrap titles, bring back labels hidden between panels, narrow the legends; returns inches they need."""
    letters = 44 // columns
    extra, label = 0.1, ""
    for axes in shown:
        axes.set_title(textwrap.fill(axes.get_title(), letters), fontsize=9)
        extra += (0.2 + 0.15 * axes.get_title().count("\n")) / columns if axes.get_title() else 0.0
        label = axes.get_ylabel() or (label if axes.get_shared_y_axes().get_siblings(axes)[1:] else "")
        names = max((len(text.get_text()) for text in axes.get_yticklabels()), default=0)
        room = max(14, letters - max(10, names))
        axes.set(ylabel=textwrap.fill(label, 40), xlabel=textwrap.fill(axes.get_xlabel(), room))
        if axes.xaxis.get_visible() and len(axes.get_xticks()):
            axes.tick_params(labelbottom=True, labelleft=True)
        if (old := axes.get_legend()) is not None and len(old.get_texts()) > 3:
            axes.legend(**_entries(old), ncols=2)
    for old in list(figure.legends):
        old.remove()
        figure.legend(**_entries(old), ncols=1, loc="outside lower center")
        extra += 0.2 * len(old.get_texts())
    return extra


def _entries(legend: Legend) -> dict[str, Any]:
    title = legend.get_title().get_text() or None
    labels = [text.get_text() for text in legend.get_texts()]
    return {"handles": legend.legend_handles, "labels": labels, "title": title, "fontsize": 8}


def coloured_png(image: Array, colours: str, low: float, high: float) -> str:
    """Data address of an image in one of matplotlib's colour maps, transparent where it is NaN.

    Args:
        image: (ny, nx), one value per pixel of the picture.
        colours: name of the colour map.
        low: value of its first colour, ``high``: of its last; values outside get the nearest colour.
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


def colour_bar_png(colours: str) -> str:
    """The colours from low to high, one pixel high, to be stretched."""
    return coloured_png(np.linspace(0, 1, _COLOURS)[None, :], colours, 0.0, 1.0)


def shown_html(line: str, **images: Array) -> str:
    """What a notebook shows of an object with maps: the line of its ``repr``, and each map with its range.

    Args:
        line: the line.
        images: maps (ny, nx) by what they show.
    """
    figures = []
    for name, values in images.items():
        image = np.where(np.isfinite(values), values, np.nan)
        step = max(1, -(-max(image.shape) // _NOTEBOOK_PX))
        low, high = float(np.nanmin(image)), float(np.nanmax(image))
        png = coloured_png(image[::step, ::step], "viridis", low, high)
        caption = f"{name.replace('_um', ', µm').replace('_', ' ')}: {low:.3g} … {high:.3g}"
        figures.append(
            f'<figure style="display:inline-block;margin:.3em"><img src="{png}" alt="{name}" '
            f'style="width:{_NOTEBOOK_PX}px"><figcaption>{caption}</figcaption></figure>'
        )
    return f"<p>{html.escape(line)}</p>{''.join(figures)}"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
