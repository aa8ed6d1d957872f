"""Draw the heights of a scan as a PNG picture with axes and a colour scale."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation import atomic_file
from litho_data.reports.pictures import limits, new_figure
from litho_data.scan import Scan

_COLOURS = "viridis"


def write_picture(scan: Scan, path: str | Path) -> Path:
    """Write a PNG picture of the heights in nm, with row 0 at the top and the outline of the scan's mask in
    red. The axes are in µm, or in px if the pitch is unknown.
    """
    ny, nx = scan.shape
    unit, pitch = ("µm", scan.pitch_um) if scan.pitch_um is not None else ("px", (1.0, 1.0))
    figure = new_figure(6.4, 5.2)
    axes = figure.add_subplot()
    low, high = limits(scan.height_um * 1e3)
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
