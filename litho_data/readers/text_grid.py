"""Find the coordinates in a table of numbers. The coordinates are the first row, the first column or both
of a matrix, or two columns with the x and y of points that fill a grid.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from litho_data.foundation import YX, Array, InputError, is_length, um_per

# Coordinates are written with few digits, so a step may differ from the mean step by this share of the mean
# step.
_UNEVEN = 0.02
_FEWEST_STEPS = 3
# If only one of the first row and the first column is evenly spaced, it must have at least this many numbers
# to be taken as an axis. If both look like axes with uneven steps, the table is rejected only if each has at
# least this many numbers.
_FEWEST_ALONE = 6
_FEWEST_POINTS = 32
_COLUMN = re.compile(
    r"\b([xyz])\b[^\[(xyz]{0,20}[\[(]\s*([^\])\s]{1,12})\s*[\])]|\b([xyz])\s+in\s+(\S{1,12})", re.IGNORECASE
)

_IN_UNIT = re.compile(r"\s*[\[(][^\])]*[\])]|\s+in\s+\S+")
_GAPS = re.compile(r"\s*[,;\t]\s*|\s+")
_AXIS = re.compile(r"[xyz](?![a-z])|(?=height)")


@dataclass(frozen=True)
class Map:
    """A map of heights without its axes, with row 0 at the top and x to the right.

    ``size_um`` contains the side lengths (y, x) in µm, if the table states them with a unit. ``extent``
    contains the side lengths (y, x) in the unit of the coordinates, even if the table does not state this
    unit. ``x_is`` says in words whether rows or columns of the file run along x. ``corner`` is true if the
    first cell of the table does not belong to the map. This cell may then contain a word.
    """

    values: Array
    extent: YX | None = None
    size_um: YX | None = None
    x_is: str = "a row of the file"
    corner: bool = False
    notes: tuple[str, ...] = ()


def without_axes(values: Array, words: Sequence[str]) -> Map:
    """Remove the first row, the first column or both from a matrix, if they contain coordinates or pixel
    numbers.

    A row or column of evenly spaced numbers is taken as coordinates, unless the row or column beside it has
    the same spacing. In that case, both belong to the map, because neighbouring rows or columns of a map are
    alike. The numbers 0, 1, 2, … (or 1, 2, 3, …) count pixels and say nothing about lengths.

    Raises:
        InputError: the first row and column look like coordinates that are not evenly spaced, or the
            coordinates seem to stand in the last row and column.
    """
    body = values[1:, 1:]
    if min(body.shape) <= _FEWEST_STEPS:
        return Map(values)
    row, column = values[0, 1:], values[1:, 0]
    x, y = _spacing(row), _spacing(column)
    has_x = x is not None and not _goes_on(body[0], x)
    has_y = y is not None and not _goes_on(body[:, 0], y)
    if has_x and has_y:
        extent = (abs(y or 0.0) * body.shape[0], abs(x or 0.0) * body.shape[1])
        if _counts(row) and _counts(column):
            return Map(body, corner=True)
        return Map(body if x and x > 0 else body[:, ::-1], extent, _size_um(words, extent), corner=True)
    if has_y and len(column) >= _FEWEST_ALONE:
        return Map(
            values[:, 1:], notes=("its first column was taken as an axis, because it is evenly spaced",)
        )
    if has_x and x and x > 0 and len(row) >= _FEWEST_ALONE:
        return Map(
            values[1:],
            corner=True,
            notes=("its first row was taken as an axis, because it is evenly spaced",),
        )
    pairs = ((row, body[0]), (column, body[:, 0]))
    if all(len(line) >= _FEWEST_ALONE and _rises(line) and not _rises(beside) for line, beside in pairs):
        raise InputError("first row and column that rise like axes", got="uneven steps", wanted="even steps")
    ends = ((values[-1, :-1], values[-2, :-1]), (values[:-1, -1], values[:-1, -2]))
    if all((step := _spacing(line)) and not _goes_on(beside, step) for line, beside in ends):
        raise InputError("axes in the last row and column", wanted="axes in the first row and column")
    return Map(values)


def _rises(line: Array) -> bool:
    steps = np.diff(line)
    return bool((steps > 0).all() or (steps < 0).all())


def _spacing(line: Array) -> float | None:
    """Return the step of evenly spaced numbers, or None if the numbers are not evenly spaced."""
    steps = np.diff(line)
    if len(steps) < _FEWEST_STEPS or not np.isfinite(steps).all():
        return None
    step = float((line[-1] - line[0]) / len(steps))
    return step if step and np.allclose(steps, step, rtol=_UNEVEN, atol=0) else None


def _goes_on(line: Array, step: float) -> bool:
    other = _spacing(line)
    return other is not None and bool(np.isclose(other, step, rtol=_UNEVEN, atol=0))


def _counts(line: Array) -> bool:
    return bool(line[0] in (0, 1) and (np.diff(line) == 1).all())


def _size_um(words: Sequence[str], extent: YX) -> YX | None:
    """Return the size (y, x) in µm if the words above the numbers give a unit for x. Otherwise return None.
    If the words give no unit for y, the unit of x is used for y.
    """
    pairs = [(one[0] or one[2], one[1] or one[3]) for text in words for one in _COLUMN.findall(text[:200])]
    units = {axis.lower(): unit for axis, unit in pairs if is_length(unit)}
    if "x" not in units:
        return None
    return extent[0] * um_per(units.get("y", units["x"])), extent[1] * um_per(units["x"])


def _columns(words: Sequence[str], count: int) -> list[int]:
    """Return the indices, from 0, of the columns that contain x, y and z.

    The columns are identified by the words above them. Without such words, a table with three columns is
    taken to contain x, y and z in this order. For a table with another number of columns, the list is then
    empty.
    """
    for text in words:
        names = _GAPS.split(_IN_UNIT.sub("", text[:200].lower()).strip("#% "))
        axes = [found[0] or "z" if (found := _AXIS.match(name)) else "" for name in names]
        if len(axes) == count and all(axes.count(axis) == 1 for axis in "xyz"):
            return [axes.index(axis) for axis in "xyz"]
    return [0, 1, 2] if count == len("xyz") else []


def map_of_points(points: Array, words: Sequence[str]) -> Map | None:
    """Make a map from a table of points that fill a regular grid, or return None if they do not fill one.

    The columns are x, y, z unless the words above them say otherwise. In the map, x grows to the right, and
    rows keep the order of the file. Grid points that the file lacks become missing pixels.
    """
    columns = _columns(words, points.shape[1])
    if not columns:
        return None
    points = points[:, columns]
    x, column = np.unique(points[:, 0], return_inverse=True)
    y, row = np.unique(points[:, 1], return_inverse=True)
    step_x, step_y = _spacing(x), _spacing(y)
    filled = len(points) / max(1, len(x) * len(y))
    if len(points) < _FEWEST_POINTS or step_x is None or step_y is None or not 0.5 < filled <= 1:
        return None
    if len(np.unique(row * len(x) + column)) != len(points):
        return None
    down = points[0, 1] <= points[-1, 1]
    values = np.full((len(y), len(x)), np.nan)
    values[row if down else len(y) - 1 - row, column] = points[:, 2]
    extent = (step_y * len(y), step_x * len(x))
    size_um = _size_um(words, extent)
    # Rows keep the order of the file.
    x_is = f"column {columns[0] + 1} of points; y {'grows' if down else 'falls'} downwards"
    counted = _counts(x) and _counts(y)
    return Map(values, None if counted else extent, size_um, x_is=x_is)
