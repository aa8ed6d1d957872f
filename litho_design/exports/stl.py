"""Write a layout as a closed solid (binary STL, µm). The top of each cell consists of two triangles.
Neighbouring cells of different levels are joined by a vertical wall.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER_BYTES = 80
# If two columns touch only along an edge, the higher column is moved away from the edge by this share of a
# cell.
_APART = 1 / 128
# Directions (x, y) from a grid point to the four cells around it: south-west, south-east, north-west,
# north-east.
_WAY = np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)], np.float32)
_BELOW = -1


def write_stl(
    path: Path, levels: np.ndarray, cell_um: float, level_height_um: float, pedestal_um: float
) -> int:
    """Write a solid in which the top of each cell has the height ``pedestal_um + level * level_height_um``.
    Return the number of triangles.

    Every edge belongs to two triangles, even where columns touch only along an edge (see ``step_solid``).

    Args:
        levels: integer level of each cell, shape (ny, nx), with row 0 at the top. In the file, y points
            upwards.
        cell_um: side of one cell.
        pedestal_um: height of the base under level 0; must be positive.

    Raises:
        InputError: there is no pedestal, so level 0 would have no volume.
    """
    if pedestal_um <= 0:
        raise InputError(
            "pedestal_um", got=pedestal_um, wanted="a positive height, because a closed solid needs a base"
        )
    triangles = step_solid(levels[::-1])
    height_um = triangles[..., 2] * level_height_um + pedestal_um
    triangles[..., 2] = np.where(triangles[..., 2] < 0, 0.0, height_um)
    triangles[..., :2] *= cell_um
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    records = np.zeros(len(triangles), _RECORD)
    records["normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    records["corners"] = triangles
    with open(path, "wb") as stream:
        stream.write(b"litholoop layout, micrometres".ljust(_HEADER_BYTES))
        stream.write(np.uint32(len(records)).astype("<u4").tobytes())
        stream.write(records.tobytes())
    return len(records)


def step_solid(levels: np.ndarray) -> np.ndarray:
    """Return the triangles of the solid that has one column per cell.

    Every edge belongs to two triangles, which traverse it in opposite directions. For this purpose, a wall
    has vertices along its two vertical ends, at the tops of all columns that meet there.

    Args:
        levels: non-negative integers, shape (ny, nx); y increases with the row.

    Returns:
        Float32 array of shape (m, 3, 3) with axes triangle, corner and coordinate (x, y, z). The unit of x
        and y is one cell, and the unit of z is one level. The underside lies at z = -1. Seen from outside,
        the corners of a triangle run counter-clockwise.
    """
    cells = np.pad(np.asarray(levels, np.int16), 1, constant_values=_BELOW)
    around = np.stack([cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]], axis=-1)
    aside = np.zeros(around.shape, bool)
    for high, low in (([0, 3], [1, 2]), ([1, 2], [0, 3])):
        touch = around[..., high].min(-1) > around[..., low].max(-1)
        first = touch & (around[..., high[0]] >= around[..., high[1]])
        aside[..., high[0]] |= first
        aside[..., high[1]] |= touch & ~first
    turned = [0, 2, 1, 3]
    across = _walls(cells.T, around.swapaxes(0, 1)[..., turned], aside.swapaxes(0, 1)[..., turned])
    return np.concatenate(
        [
            _tops(around, aside),
            _walls(cells, around, aside),
            across[:, ::-1, [1, 0, 2]],
            _underside(levels.shape),
        ]
    )


def _corner(point: np.ndarray, z: np.ndarray, way: int | np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the positions (x, y, z) of n grid points. The result has shape (n, 3).

    ``point`` contains the row and the column of each point, shape (n, 2). Where ``moved`` is True, the point
    is shifted slightly in the direction ``way``, towards one of the cells around it.
    """
    at = point[:, ::-1] + _APART * moved[:, None] * _WAY[way]
    return np.concatenate([at, z[:, None]], axis=1).astype(np.float32)


def _tops(around: np.ndarray, aside: np.ndarray) -> np.ndarray:
    """Return the two triangles of the top of each cell."""
    cell = np.argwhere(around[:-1, :-1, 3] >= 0)
    z = around[cell[:, 0], cell[:, 1], 3]
    # The loop goes around the cell. It starts at the south-west point of the cell; the cell lies north-east
    # of this point.
    corners = []
    for step, way in (((0, 0), 3), ((0, 1), 2), ((1, 1), 0), ((1, 0), 1)):
        point = cell + step
        corners.append(_corner(point, z, way, aside[point[:, 0], point[:, 1], way]))
    a, b, c, d = corners
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _walls(cells: np.ndarray, around: np.ndarray, aside: np.ndarray) -> np.ndarray:
    """Return the triangles of the vertical walls between neighbouring rows of cells."""
    row, column = np.nonzero(cells[:-1, 1:-1] != cells[1:, 1:-1])
    south, north = cells[row, column + 1], cells[row + 1, column + 1]
    low, high = np.minimum(south, north), np.maximum(south, north)
    ends = []
    # For each end of a wall (west, east), ``place`` is the direction in which the higher of the two cells
    # lies.
    for point, place in (
        (np.stack([row, column], 1), np.where(north > south, 3, 1)),
        (np.stack([row, column + 1], 1), np.where(north > south, 2, 0)),
    ):
        at = (point[:, 0], point[:, 1])
        moved, levels = aside[*at, place], around[at].copy()
        # If a column was moved away from another one, its edge no longer touches that column.
        opposite = np.arange(len(row)), 3 - place
        levels[opposite] = np.where(moved, low, levels[opposite])
        chain = np.sort(levels.clip(low[:, None], high[:, None]), axis=1)
        ends.append([_corner(point, z, place, moved & (z == high)) for z in chain.T])
    west, east = ends
    strips = [(west[0], east[i], east[i + 1]) for i in range(3)]
    strips += [(west[i], east[3], west[i + 1]) for i in range(3)]
    found = []
    for a, b, c in strips:
        # In ``strips``, the corners run counter-clockwise as seen from the south. The outside of a wall is
        # the side of the lower cell.
        faces = np.where((south > north)[:, None, None], np.stack([c, b, a], 1), np.stack([a, b, c], 1))
        corners_apart = (a != b).any(1) & (b != c).any(1) & (c != a).any(1)
        found.append(faces[corners_apart])
    return np.concatenate(found)


def _underside(shape: tuple[int, ...]) -> np.ndarray:
    """Return the triangles of the underside, which form a fan from the middle to all points on the rim."""
    ny, nx = shape
    south, east = [(0, x) for x in range(nx)], [(y, nx) for y in range(ny)]
    north, west = [(ny, x) for x in range(nx, 0, -1)], [(y, 0) for y in range(ny, 0, -1)]
    rim = np.array([*south, *east, *north, *west], float)
    corners = np.concatenate([rim[:, ::-1], np.full((len(rim), 1), _BELOW)], axis=1)
    middle = np.broadcast_to([nx / 2, ny / 2, _BELOW], corners.shape)
    return np.stack([middle, np.roll(corners, -1, axis=0), corners], axis=1).astype(np.float32)
