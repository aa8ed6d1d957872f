"""The closed surface of columns of whole levels, of no more triangles than its corners need."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

# Where columns touch along an edge only, one of them keeps this share of a cell away from it.
_APART = 1 / 128
# Cells around a point, and the way from the point to them: south-west, south-east, north-west, north-east.
_AROUND = np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)])
_BELOW = -1


def step_solid(levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (n, 3) and triangles (m, 3) of the solid that has one column per cell.

    A level's top is one face as far as it reaches, and so is a wall. Faces keep every corner on their rim:
    an edge has two faces, no corner lies within an edge, and V corners make 2 V - 4 triangles.

    Args:
        levels: integers (ny, nx) of 0 or more; y grows with the row.

    Returns:
        x and y in cells, z in levels, with -1 for the underside; triangles counter-clockwise from outside.
    """
    cells = np.pad(np.asarray(levels, np.int64), 1, constant_values=_BELOW)
    corners, points, moved = _corners(cells)
    tops, areas = _rings_of_tops(cells, corners)
    found = [_triangles(points, (0, 1), tops, areas)[0]]
    turned = [0, 2, 1, 3]
    walls = {
        (0, 2): _rings_of_walls(cells, corners, moved),
        (1, 2): _rings_of_walls(
            cells.T, corners.transpose(1, 0, 2)[..., turned], moved.transpose(1, 0, 2)[..., turned]
        ),
    }
    for axes, (rings, ahead) in walls.items():
        triangles, face = _triangles(points, axes, rings, list(range(len(rings))))
        # Seen along y, x goes to the right; seen along x, y goes to the left.
        turn = np.array(ahead)[face] != (axes == (1, 2))
        triangles[turn] = triangles[turn, ::-1]
        found.append(triangles)
    a, b, c, d = (
        corners[row, column, place] for row, column, place in ((0, 0, 0), (0, -1, 1), (-1, -1, 3), (-1, 0, 2))
    )
    return points, np.concatenate([*found, [[a, c, b], [a, d, c]]])


def _corners(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers of the corners (ny, nx, 4) at every point, one per cell around it, -1 where the cell has none.

    Also their places (n, 3), and which cells' corners were moved (ny, nx, 4).
    """
    around = np.stack([cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]], axis=-1)
    side = np.sign(around[..., None, :] - around[..., :, None])
    # The solid does not change along x, or along y, through this height of the point.
    along_x = (side[..., 0] == side[..., 1]) & (side[..., 2] == side[..., 3])
    along_y = (side[..., 0] == side[..., 2]) & (side[..., 1] == side[..., 3])
    at = np.indices(around.shape[:2])
    key = (at[0] * around.shape[1] + at[1])[..., None] * (around.max() + 2) + around + 1
    corner = ~(along_x | along_y)
    _, first, number = np.unique(key[corner], return_index=True, return_inverse=True)
    numbers = np.full(around.shape, -1)
    numbers[corner] = number
    where = np.argwhere(corner)[first]
    points = np.stack([where[:, 1], where[:, 0], around[corner][first]], axis=1).astype(np.float64)

    moved = np.zeros(around.shape, bool)
    extra: list[list[int]] = []
    for high, low in (([0, 3], [1, 2]), ([1, 2], [0, 3])):
        rows, columns = np.nonzero(around[..., high].min(-1) > around[..., low].max(-1))
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            here = around[row, column]
            if here[high[0]] != here[high[1]]:
                one = max(high, key=here.__getitem__)
            elif here[low[0]] != here[low[1]]:
                one = min(low, key=here.__getitem__)
            else:
                one = high[0]
                numbers[row, column, one] = len(points) + len(extra)
                extra.append([column, row, here[one]])
            moved[row, column, one] = True
    points = np.concatenate([points, np.reshape(extra, (-1, 3))])
    points[numbers[moved], :2] += _APART * _AROUND[np.nonzero(moved)[2]]
    return numbers, points, moved


def _rings_of_tops(cells: np.ndarray, corners: np.ndarray) -> tuple[list[list[int]], list[int]]:
    """Rims of connected cells of one level as numbers of corners, cells on the left; and the area of each."""
    label = _connected(cells).ravel()
    width = cells.shape[1]
    flat = cells.ravel()
    # Sides of a cell: south, east, north, west; what lies beyond, and the next cell along the side.
    beyond, along = np.array([-width, 1, width, -1]), np.array([1, width, -1, -width])
    cell, side = np.nonzero(flat[:, None] != flat[(np.arange(flat.size)[:, None] + beyond) % flat.size])
    inside = flat[cell] >= 0
    cell, side = cell[inside], side[inside]
    ahead = cell + along[side]
    across = ahead + beyond[side]
    row, column = np.divmod(cell, width)
    # The side starts at this point, where the cell has this place; it ends where the next side starts.
    start_row, start_column = np.array([-1, -1, 0, 0]), np.array([-1, 0, 0, -1])
    place, place_across = np.array([3, 2, 0, 1]), np.array([0, 1, 3, 2])
    ends = (side + 1) % 4
    own = corners[row + start_row[side], column + start_column[side], place[side]]
    end_row, end_column = row + start_row[ends], column + start_column[ends]
    met = corners[end_row, end_column, place[ends]] == corners[end_row, end_column, place_across[ends]]
    same_across = label[across] == label[cell]
    straight = flat[ahead] == flat[cell]
    # Where the cell across is of the same top and shares the corner, rims cross: none meets itself.
    right = same_across & (straight | met)
    following = np.where(
        right, across * 4 + (side + 3) % 4, np.where(straight, ahead * 4 + side, cell * 4 + ends)
    )
    index = np.full(flat.size * 4, -1)
    index[cell * 4 + side] = np.arange(cell.size)
    next_one, number = index[following].tolist(), own.tolist()
    rings, labels, seen = [], [], [False] * cell.size
    for first in range(cell.size):
        if seen[first]:
            continue
        ring, at = [], first
        while not seen[at]:
            seen[at] = True
            if number[at] >= 0:
                ring.append(number[at])
            at = next_one[at]
        rings.append(ring)
        labels.append(int(label[cell[first]]))
    return rings, labels


def _connected(cells: np.ndarray) -> np.ndarray:
    """Number of the connected area of equal cells, of the shape of ``cells``."""
    number = np.arange(cells.size).reshape(cells.shape)
    pairs = [
        np.stack([one[same], other[same]])
        for one, other, same in (
            (number[:, :-1], number[:, 1:], cells[:, :-1] == cells[:, 1:]),
            (number[:-1], number[1:], cells[:-1] == cells[1:]),
        )
    ]
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(first.size, bool), (first, second)), shape=(cells.size, cells.size))
    return connected_components(graph, directed=False)[1].reshape(cells.shape)


def _rings_of_walls(
    cells: np.ndarray, corners: np.ndarray, moved: np.ndarray
) -> tuple[list[list[int]], list[bool]]:
    """Rims of the walls between rows, counter-clockwise in (x, z), and which of them face up the rows."""
    south, north = cells[:-1, 1:-1], cells[1:, 1:-1]
    rows, columns = np.nonzero(south != north)
    up = north[rows, columns] < south[rows, columns]
    low, high = np.minimum(south, north)[rows, columns], np.maximum(south, north)[rows, columns]
    same_piece = (
        (rows[1:] == rows[:-1])
        & (columns[1:] == columns[:-1] + 1)
        & (up[1:] == up[:-1])
        & (np.maximum(low[1:], low[:-1]) < np.minimum(high[1:], high[:-1]))
    )
    # Of the four cells at either end of a wall: the places of its low and its high one.
    ends = []
    for column, low_place, high_place in (
        (columns, np.where(up, 3, 1), np.where(up, 1, 3)),
        (columns + 1, np.where(up, 2, 0), np.where(up, 0, 2)),
    ):
        found, apart = corners[rows, column], moved[rows, column]
        lines = np.arange(rows.size)
        # Diagonally across from the low and from the high cell; the edge passes a corner it was moved from.
        between = np.stack([3 - low_place, 3 - high_place], axis=1)
        level = np.stack([cells[rows + place // 2, column + place % 2] for place in between.T], axis=1)
        kept = (level > low[:, None]) & (level < high[:, None])
        kept &= ~np.stack([apart[lines, low_place], apart[lines, high_place]], axis=1)
        number = np.where(kept, found[lines[:, None], between], -1)
        number = np.take_along_axis(number, np.argsort(level, axis=1), axis=1).tolist()
        ends.append((found[lines, low_place].tolist(), found[lines, high_place].tolist(), number))
    (low_left, high_left, left), (low_right, high_right, right) = ends
    rings, ahead = [], []
    breaks = [0, *(np.flatnonzero(~same_piece) + 1).tolist(), rows.size]
    for first, last in pairwise(breaks):
        lower, upper = [], []
        for wall in range(first, last):
            lower += [low_left[wall], low_right[wall]]
            upper += [high_left[wall], high_right[wall]]
        ring = [*lower, *right[last - 1], *upper[::-1], *left[first][::-1]]
        there = [number for number in ring if number >= 0]
        once = [
            number for before, number in zip([there[-1], *there], there, strict=False) if number != before
        ]
        rings.append(once)
        ahead.append(bool(up[first]))
    return rings, ahead


def _triangles(
    points: np.ndarray, axes: tuple[int, int], rings: list[list[int]], faces: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (m, 3) between rims, counter-clockwise along ``axes`` as they are, and the face of each.

    Rims of one face are its outer one, counter-clockwise, and its holes, clockwise.
    """
    size, face = np.array([len(ring) for ring in rings]), np.array(faces)
    number = np.concatenate([np.array(ring) for ring in rings])
    simple = (size == 4) & (np.bincount(face)[face] == 1)
    quads = number[np.repeat(simple, size)].reshape(-1, 4)
    found = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    of_found = np.tile(face[simple], 2)
    if simple.all():
        return found, of_found
    place = points[:, axes]
    # The outer rim of a face first.
    rest = np.lexsort([_is_hole(place[number], size), face])
    rest = rest[~simple[rest]]
    number = np.concatenate([np.array(rings[ring]) for ring in rest.tolist()])
    ring_of = np.repeat(np.arange(rest.size), size[rest])
    _, face_of = np.unique(face[rest], return_inverse=True)
    polygons = shapely.polygons(shapely.linearrings(place[number], indices=ring_of), indices=face_of)
    parts, whole = shapely.get_parts(shapely.constrained_delaunay_triangles(polygons), return_index=True)
    corner = shapely.get_coordinates(shapely.orient_polygons(parts)).reshape(-1, 4, 2)[:, :3]
    # A place is one corner within a face, not among faces.
    known = _key(place[number], face_of[ring_of], place)
    wanted = _key(corner.reshape(-1, 2), np.repeat(whole, 3), place)
    order = np.argsort(known)
    triangles = number[order[np.searchsorted(known, wanted, sorter=order)]].reshape(-1, 3)
    return np.concatenate([found, triangles]), np.concatenate([of_found, np.unique(face[rest])[whole]])


def _is_hole(at: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Which of the rims, one behind the other in ``at`` (n, 2), run clockwise."""
    starts = np.cumsum(sizes) - sizes
    following = np.arange(1, len(at) + 1)
    following[starts + sizes - 1] = starts
    x, y = at.T
    return np.asarray(np.add.reduceat(x * y[following] - y * x[following], starts) < 0)


def _key(at: np.ndarray, face: np.ndarray, places: np.ndarray) -> np.ndarray:
    """One integer per place and face; coordinates are passed on bit for bit, so that they can be ranked."""
    x, y = (np.unique(places[:, axis]) for axis in (0, 1))
    return (face * x.size + np.searchsorted(x, at[:, 0])) * y.size + np.searchsorted(y, at[:, 1])
