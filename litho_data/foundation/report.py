"""Self-contained HTML reports: text, tables (also as CSV), figures and small pictures in one file."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation.files import atomic_file

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

_FIGURE_DPI = 130
_COLOURS = 255
_GAP = 255  # the last entry of the palette, white

_TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
 :root { --ink:#1c2430; --soft:#5b6675; --line:#dfe4ea; --band:#f6f8fa; --accent:#0b6aa2; }
 body { font:16px/1.55 system-ui,"Segoe UI",Helvetica,Arial,sans-serif; color:var(--ink);
        max-width:1080px; margin:2.5rem auto; padding:0 1.25rem; }
 h1 { font-size:1.9rem; line-height:1.2; margin:0 0 .4rem; }
 h2 { font-size:1.25rem; margin:2.4rem 0 .6rem; padding-bottom:.25rem; border-bottom:2px solid var(--line); }
 .lead { font-size:1.1rem; color:var(--soft); margin:.2rem 0 1.4rem; }
 .note { background:#fff8e6; border-left:4px solid #d99b00; padding:.6rem .9rem; margin:1rem 0; }
 .tiles { display:flex; flex-wrap:wrap; gap:.8rem; margin:1rem 0; }
 .tile { border:1px solid var(--line); border-radius:8px; padding:.7rem 1rem; min-width:9rem; }
 .tile b { display:block; font-size:1.45rem; color:var(--accent); }
 .tile span { color:var(--soft); font-size:.88rem; }
 .scroll { overflow-x:auto; }
 table { border-collapse:collapse; font-size:.9rem; margin:.5rem 0; font-variant-numeric:tabular-nums; }
 th,td { padding:.35rem .7rem; border-bottom:1px solid var(--line); text-align:left; vertical-align:top; }
 td.n, th.n { text-align:right; }
 thead th { background:var(--band); position:sticky; top:0; }
 tbody tr:hover { background:var(--band); }
 .gallery td, .gallery th { border:0; padding:.15rem .3rem; font-weight:normal; }
 .gallery img { width:100%; min-width:7rem; display:block; } .gallery th img { height:.5rem; }
 figure { margin:1.1rem 0; } figure img { max-width:100%; height:auto; }
 figcaption, .caption { color:var(--soft); font-size:.88rem; }
 pre { background:var(--band); padding:.8rem; overflow-x:auto; font-size:.85rem; }
</style></head><body>
<h1>{{ title }}</h1>{% if lead %}<p class="lead">{{ lead }}</p>{% endif %}
{% for part in parts %}
{% if part.kind == "heading" %}<h2>{{ part.text }}</h2>
{% elif part.kind == "paragraph" %}<p>{{ part.text }}</p>
{% elif part.kind == "note" %}<p class="note">{{ part.text }}</p>
{% elif part.kind == "code" %}<pre>{{ part.text }}</pre>
{% elif part.kind == "tiles" %}<div class="tiles">{% for value, label in part.tiles %}
<div class="tile"><b>{{ value }}</b><span>{{ label }}</span></div>{% endfor %}</div>
{% elif part.kind == "figure" %}<figure>
<img alt="{{ part.caption }}" src="data:image/png;base64,{{ part.png }}">
<figcaption>{{ part.caption }}</figcaption></figure>
{% elif part.kind == "gallery" %}<figure><div class="scroll"><table class="gallery"><thead><tr><th></th>
{% for title, png in part.columns %}
<th>{{ title }}<img alt="" src="data:image/png;base64,{{ png }}"></th>{% endfor %}
</tr></thead><tbody>{% for label, pngs in part.rows %}<tr><td>{{ label }}</td>{% for png in pngs %}
<td><img alt="{{ label }}" src="data:image/png;base64,{{ png }}"></td>{% endfor %}</tr>
{% endfor %}</tbody></table></div><figcaption>{{ part.caption }}</figcaption></figure>
{% elif part.kind == "table" %}<p class="caption">{{ part.caption }}</p><div class="scroll"><table><thead><tr>
{% for column in part.columns %}
<th{% if column.numeric %} class="n"{% endif %}>{{ column.name }}</th>{% endfor %}
</tr></thead><tbody>{% for row in part.rows %}<tr>{% for cell in row %}
<td{% if part.columns[loop.index0].numeric %} class="n"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% elif part.kind == "links" %}<ul>{% for target, text in part.links %}
<li><a href="{{ target }}">{{ text }}</a></li>
{% endfor %}</ul>
{% endif %}{% endfor %}
</body></html>
"""


class Page:
    """A report under construction; parts appear in the order in which they are added."""

    def __init__(self, title: str, lead: str = ""):
        self.title = title
        self.lead = lead
        self._parts: list[dict[str, Any]] = []
        self._tables: list[tuple[str, pd.DataFrame]] = []

    def heading(self, text: str) -> None:
        """Start a section."""
        self._parts.append({"kind": "heading", "text": text})

    def paragraph(self, text: str) -> None:
        """Plain prose."""
        self._parts.append({"kind": "paragraph", "text": text})

    def note(self, text: str) -> None:
        """Something the reader must not overlook."""
        self._parts.append({"kind": "note", "text": text})

    def code(self, text: str) -> None:
        """A command or another fixed-width text; nothing if it is empty."""
        if not text:
            return
        self._parts.append({"kind": "code", "text": text})

    def tiles(self, tiles: Sequence[tuple[str, str]]) -> None:
        """The few figures that matter most: (value with unit, label)."""
        self._parts.append({"kind": "tiles", "tiles": list(tiles)})

    def links(self, links: Sequence[tuple[str, str]]) -> None:
        """Relative links: (target, text)."""
        self._parts.append({"kind": "links", "links": list(links)})

    def table(self, frame: pd.DataFrame, caption: str, csv_name: str, digits: int = 2) -> None:
        """A table; ``write`` also saves it at full precision as ``csv_name`` beside the page."""
        columns = [{"name": str(name), "numeric": frame[name].dtype.kind in "iufb"} for name in frame.columns]
        rows = [[_cell(value, digits) for value in row] for row in frame.itertuples(index=False)]
        self._parts.append({"kind": "table", "caption": caption, "columns": columns, "rows": rows})
        self._tables.append((csv_name, frame))

    def figure(self, figure: Figure, caption: str) -> None:
        """A matplotlib figure, embedded as PNG."""
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_FIGURE_DPI, bbox_inches="tight")
        self._parts.append({"kind": "figure", "caption": caption, "png": _base64(buffer.getvalue())})

    def gallery(
        self,
        columns: Sequence[tuple[str, bytes]],
        rows: Sequence[tuple[str, Sequence[bytes]]],
        caption: str,
    ) -> None:
        """Small PNG pictures in rows and columns.

        Args:
            columns: title and colour bar of each.
            rows: label and one picture per column.
            caption: below.
        """
        self._parts.append(
            {
                "kind": "gallery",
                "columns": [(title, _base64(png)) for title, png in columns],
                "rows": [(label, [_base64(png) for png in pngs]) for label, pngs in rows],
                "caption": caption,
            }
        )

    def write(self, folder: str | Path, name: str = "report.html") -> Path:
        """Write the page and its CSV tables into ``folder``; returns the path of the page."""
        import jinja2

        target = Path(folder)
        for csv_name, frame in self._tables:
            with atomic_file(target / csv_name) as temporary:
                frame.to_csv(temporary, index=False)
        html = jinja2.Environment(autoescape=True).from_string(_TEMPLATE)
        text = html.render(title=self.title, lead=self.lead, parts=self._parts)
        with atomic_file(target / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
        return target / name


def new_figure(width_inch: float, height_inch: float) -> Figure:
    """A figure outside pyplot's global state, so that reports never leak memory or need a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inch, height_inch), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _base64(png: bytes) -> str:
    return base64.b64encode(png).decode()


def _cell(value: Any, digits: int) -> str:
    if isinstance(value, float):
        return "–" if value != value else f"{value:.{digits}f}"
    return str(value)


def coloured_png(image: np.ndarray, colours: str, low: float, high: float) -> bytes:
    """An image in one of matplotlib's colour maps, white where it is NaN.

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
    picture.save(buffer, format="png", compress_level=4)
    return buffer.getvalue()


def colour_bar_png(colours: str) -> bytes:
    """The colours from low to high, one pixel high, to be stretched."""
    return coloured_png(np.linspace(0, 1, _COLOURS)[None, :], colours, 0.0, 1.0)
