"""Pictures of a scan: a PNG with axes and scale, and a preview in the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation.files import atomic_file
from litho_data.foundation.kinds import Array
from litho_data.foundation.report_pictures import new_figure
from litho_data.scan import Scan

if TYPE_CHECKING:
    from rich.text import Text

_COLOURS = "viridis"
_PERCENTILES = (0.5, 99.5)
_PREVIEW_COLUMNS = 64


def write_picture(scan: Scan, path: str | Path) -> Path:
    """Write a PNG of the heights in nm, row 0 on top, axes in µm (in px where the pitch is unknown)."""
    ny, nx = scan.shape
    unit, pitch = ("µm", scan.pitch_um) if scan.pitch_um is not None else ("px", (1.0, 1.0))
    figure = new_figure(6.4, 5.2)
    axes = figure.add_subplot()
    low, high = _limits(scan.height_um * 1e3)
    image = axes.imshow(
        scan.height_um * 1e3,
        extent=(0, nx * pitch[1], ny * pitch[0], 0),
        cmap=_COLOURS,
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    if scan.mask is not None:
        axes.contour(
            (np.arange(nx) + 0.5) * pitch[1],
            (np.arange(ny) + 0.5) * pitch[0],
            scan.mask.astype(float),
            levels=[0.5],
            colors="red",
            linewidths=0.6,
        )
    axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})", title=f"{scan.name}: {scan.channel}")
    figure.colorbar(image, ax=axes, label="height (nm)", extend="both")
    target = Path(path)
    with atomic_file(target) as temporary:
        figure.savefig(temporary, format="png", dpi=150, bbox_inches="tight")
    return target


def terminal_preview(scan: Scan) -> Text:
    """The heights as coloured half blocks, two rows per line of text."""
    import matplotlib
    from rich.color import Color
    from rich.style import Style
    from rich.text import Text

    columns = min(_PREVIEW_COLUMNS, scan.shape[1])
    aspect = 1.0 if scan.pitch_um is None else scan.pitch_um[0] / scan.pitch_um[1]
    rows = max(2, round(columns * scan.shape[0] / scan.shape[1] * aspect / 2) * 2)
    picked = scan.height_um[np.ix_(_middles(scan.shape[0], rows), _middles(scan.shape[1], columns))]
    low, high = _limits(scan.height_um)
    shades = np.clip((picked - low) / max(high - low, np.finfo(float).tiny), 0, 1)
    colours = matplotlib.colormaps[_COLOURS](np.nan_to_num(shades))[..., :3] * 255
    text = Text()
    for top, bottom in zip(colours[::2], colours[1::2], strict=True):
        for upper, lower in zip(top, bottom, strict=True):
            text.append("▀", Style(color=Color.from_rgb(*upper), bgcolor=Color.from_rgb(*lower)))
        text.append("\n")
    return text


def _limits(height: Array) -> tuple[float, float]:
    """Limits that do not depend on a few outliers."""
    low, high = np.nanpercentile(height, _PERCENTILES)
    return float(low), float(high)


def _middles(n: int, count: int) -> Array:
    return ((np.arange(count) + 0.5) * n / count).astype(int)
