"""Check that everything drawn in a figure is visible, and that its axes are labelled.

``tests/conftest.py`` checks every figure of every report that a test makes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np

from litho_data.reports import page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# A blank picture that replaces figures: drawing one takes half a second, and the tests make hundreds.
_BLANK = "data:image/svg+xml;base64,PHN2ZyB4bWxucz0iaHR0cDovL3d3dy53My5vcmcvMjAwMC9zdmciLz4="


@contextmanager
def undrawn() -> Iterator[None]:
    """Leave the figures of reports undrawn and without colour bars. A bar takes as long as a map."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    bar = Figure.colorbar

    def colorbar(figure: Figure, *words: Any, **named: Any) -> Any:
        return None if isinstance(figure.canvas, FigureCanvasSVG) else bar(figure, *words, **named)

    with (
        patch.object(page, "svg_address", lambda figure: _BLANK),
        patch.object(Figure, "colorbar", colorbar),
    ):
        yield


def require_legible(figure: Figure) -> None:
    """Fail if a line, dot, bar or map of a figure is invisible, or if an axis has no label."""
    assert figure.axes, "the figure has no axes"
    for axes in figure.axes:
        drawn = [*axes.lines, *axes.patches, *axes.images, *axes.collections]
        assert drawn or not axes.axison, "the axes are empty"
        for one in drawn:
            assert one.get_alpha() is None or np.all(np.asarray(one.get_alpha()) > 0), f"{one} is transparent"
        for line in axes.lines:
            stroke = line.get_linestyle() != "None" and line.get_linewidth() > 0
            dots = line.get_marker() not in ("None", None, "") and line.get_markersize() > 0
            assert stroke or dots, f"{line} has no width"
        for image in axes.images:
            low, high = image.get_clim()
            assert low is None or not low > high, f"the colour scale runs from {low} to {high}"
        if axes.axison and (axes.lines or axes.patches) and not hasattr(axes, "_colorbar"):
            _require_names(axes)


def _require_names(axes: Axes) -> None:
    """Fail unless each axis, or another axis that shares its scale, has tick labels or a name."""
    for axis, others in ((axes.xaxis, axes.get_shared_x_axes()), (axes.yaxis, axes.get_shared_y_axes())):
        which = f"{axis.axis_name}axis"
        alike = [getattr(one, which) for one in others.get_siblings(axes)]
        named = any(one.get_label_text() for one in alike)
        assert named or any(text.get_text() for text in axis.get_ticklabels()), f"{which} has no name"
    labelled = [text for text in axes.get_legend_handles_labels()[1] if text]
    assert axes.figure is not None
    first = axes.get_subplotspec()
    shares = first is not None and not first.is_first_col()
    shown = axes.get_legend() or axes.figure.legends or shares
    assert shown or not labelled, f"no legend explains {labelled}"
