"""Draw calibration patterns, each of which isolates one property of the printer.

All pattern functions return an array of levels, shape (ny, nx), in the smallest unsigned type. Lengths are in
whole pixels.
"""

from collections.abc import Sequence

import numpy as np

from litho_data.foundation import Array, InputError, Shape, require_known


def flat(shape: Shape, *, level: int) -> Array:
    """Draw a layout with the same level everywhere, to measure roughness, vignetting and flatness."""
    return np.full(shape, level, np.min_scalar_type(level))


def step_ladder(shape: Shape, *, highest: int) -> Array:
    """Draw a staircase that rises along x, with one step for each level from 0 to ``highest``, to measure how
    the printed height depends on the level. All steps have about the same width.
    """
    _positive(highest, "highest level of a step ladder")
    steps = highest + 1
    if shape[1] < steps:
        raise InputError("width of a step ladder", got=f"{shape[1]} px", wanted=f"at least {steps} px")
    stairs = np.arange(shape[1]) * steps // shape[1]
    return _rows(stairs, shape)


def framed_ladder(frame: Array, *, highest: int, tread_px: int, lowest: int = 0) -> Array:
    """Draw a staircase that rises along x inside a registration frame, to measure how the printed height and
    the roughness depend on the level.

    A staircase alone looks the same after a shift along its edges, so a scan of it cannot be registered. The
    frame makes registration possible. Its width, on each side, is a fifth of the layout's side length. The
    staircase rises evenly from ``lowest`` to ``highest``, with one step for each level if there is room.

    Args:
        frame: layout of shape (ny, nx) that has no periodic pattern. The staircase replaces its middle.
        highest: level of the last step.
        tread_px: smallest allowed width of a step, in pixels. At least 3 steps of this width must fit.
        lowest: level of the first step.
    """
    inset_y, inset_x = (size // 5 for size in frame.shape)
    width = frame.shape[1] - 2 * inset_x
    steps = min(highest - lowest + 1, width // max(1, tread_px))
    if steps < 3:
        raise InputError(
            "size of a framed ladder",
            got=f"{frame.shape[1]} px and {highest - lowest + 1} levels",
            wanted=f"at least {5 * tread_px} px and 3 levels, for three steps of {tread_px} px",
        )
    levels = np.rint(np.linspace(lowest, highest, steps))
    layout = frame.astype(np.min_scalar_type(highest))
    layout[inset_y:-inset_y, inset_x:-inset_x] = levels[np.arange(width) * steps // width]
    return layout


def checkerboard(shape: Shape, *, cell_px: int, high: int, low: int = 0) -> Array:
    """Draw a checkerboard of squares whose sides are ``cell_px`` pixels long, to measure the lateral scale,
    the shear and the rounding of corners.

    The square at the top left has the level ``high``.
    """
    _positive(cell_px, "cell_px of a checkerboard")
    y, x = np.indices(shape) // cell_px
    return np.where((y + x) % 2 == 0, high, low).astype(np.min_scalar_type(high))


def line_space_sweep(
    shape: Shape, *, high: int, low: int = 0, narrowest_px: int = 1, along: str = "y"
) -> Array:
    """Draw lines, each followed by a space of the same width, to measure how well lines of each width are
    printed.

    Each line is one pixel wider than the line before.

    Args:
        narrowest_px: width of the first line.
        along: axis to which the lines are parallel, ``y`` or ``x``. Lines parallel to y follow each other
            along x.
    """
    _positive(narrowest_px, "narrowest_px of a line/space sweep")
    require_known("direction of the lines", along, ("x", "y"))
    length = shape[1] if along == "y" else shape[0]
    profile = np.full(length, low)
    start, width = 0, narrowest_px
    while start < length:
        profile[start : start + width] = high
        start, width = start + 2 * width, width + 1
    return _rows(profile, shape) if along == "y" else _rows(profile, shape[::-1]).T.copy()


def siemens_star(shape: Shape, *, spokes: int, high: int) -> Array:
    """Draw a Siemens star of ``spokes`` wedges around the centre, to measure how the resolution depends on
    the direction.

    The wedges are as wide as the gaps between them.
    """
    _positive(spokes, "spokes of a Siemens star")
    y, x = np.indices(shape)
    # The star is turned by half a wedge, so that no edge of a wedge lies on an axis of the grid.
    angle = np.arctan2(y - (shape[0] - 1) / 2, x - (shape[1] - 1) / 2) * spokes / np.pi + 0.5
    inside = np.hypot(y - (shape[0] - 1) / 2, x - (shape[1] - 1) / 2) <= 0.48 * min(shape)
    return np.where(inside & (np.floor(angle).astype(int) % 2 == 0), high, 0).astype(np.min_scalar_type(high))


def isolated_features(shape: Shape, *, widths_px: Sequence[int], feature: int, ground: int) -> Array:
    """Draw isolated squares of the given widths, to measure the size of the printer's spot and how single
    features shrink and collapse.

    If ``feature`` is above ``ground``, the squares are pillars, otherwise pits. The layout is divided into
    cells, in as many rows as columns. The cells are filled in reading order, each with one square in its
    middle. The space between two neighbouring squares is at least twice the width of the larger one.
    """
    side = int(np.ceil(len(widths_px) ** 0.5))
    cell = (shape[0] // side, shape[1] // side)
    if not widths_px or min(widths_px) < 1 or 3 * max(widths_px) > min(cell):
        raise InputError(
            "widths_px of isolated features",
            got=list(widths_px),
            wanted=f"1 to {min(cell) // 3} px in a {shape[0]} x {shape[1]} px layout",
        )
    layout = np.full(shape, ground, np.min_scalar_type(max(feature, ground)))
    for index, width in enumerate(widths_px):
        row, column = divmod(index, side)
        top = row * cell[0] + (cell[0] - width) // 2
        left = column * cell[1] + (cell[1] - width) // 2
        layout[top : top + width, left : left + width] = feature
    return layout


def relative_doses(count: int) -> Array:
    """Return the relative doses (1 is the nominal dose) of a dose matrix, evenly spaced from 0.7 to 1.3. The
    result has shape (count,).
    """
    if count < 2:
        raise InputError("dose matrix", got=count, wanted="at least 2 doses")
    return np.linspace(0.7, 1.3, count)


def _rows(profile: Array, shape: Shape) -> Array:
    return np.broadcast_to(profile.astype(np.min_scalar_type(profile.max())), shape).copy()


def _positive(value: int, what: str) -> None:
    if value < 1:
        raise InputError(what, got=value, wanted="at least 1")
