"""Pictures shared by the reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation.report import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Brightest intensity shown, in units of the target's white; speckle beyond it is clipped.
BRIGHTEST = 1.5


def image_grid(
    images: list[list[np.ndarray]], titles: list[list[str]], row_labels: list[str], side_um: float
) -> Figure:
    """Intensity images in rows and columns on one scale.

    Args:
        images: rows of images (m, m) at the scale of the target.
        titles: one title per image.
        row_labels: left of each row.
        side_um: extent of every image, µm.
    """
    rows, columns = len(images), max(len(row) for row in images)
    figure = new_figure(2.3 * columns + 0.6, 2.45 * rows)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
        axis.axis("off")
    for row, (pictures, names) in enumerate(zip(images, titles, strict=True)):
        for column, (picture, name) in enumerate(zip(pictures, names, strict=True)):
            axis = axes[row, column]
            axis.axis("on")
            axis.imshow(picture, cmap="inferno", vmin=0, vmax=BRIGHTEST, extent=(0, side_um, side_um, 0))
            axis.set_title(name, fontsize=8)
        axes[row, 0].set_ylabel(row_labels[row], fontsize=10)
    return figure
