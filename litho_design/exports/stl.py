"""Layouts as a closed solid of square columns (binary STL, µm), and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER_BYTES = 80


def write_stl(
    path: Path, levels: np.ndarray, cell_um: float, level_height_um: float, pedestal_um: float
) -> int:
    """Write columns of ``pedestal_um + level * level_height_um``; returns the number of triangles.

    Walls are cut at every level, so that triangles share whole edges and the surface is closed.

    Args:
        levels: integer levels per cell (ny, nx), row 0 on top; y grows up in the file.
        cell_um: side of one cell.
        pedestal_um: base under level 0, above 0.

    Raises:
        InputError: no pedestal: level 0 would have no volume.
    """
    if pedestal_um <= 0:
        raise InputError("pedestal_um", got=pedestal_um, wanted="a positive base for a closed solid")
    # Index space: x, y in cells, z in levels with -1 for the underside of the pedestal.
    upright = levels[::-1].astype(np.int64)
    quads = np.concatenate([_caps(upright), _walls(upright), _walls(upright.T)[:, ::-1][..., [1, 0, 2]]])
    height = np.concatenate([[0.0], pedestal_um + level_height_um * np.arange(upright.max() + 1)])
    corners = np.empty(quads.shape, np.float64)
    corners[..., :2] = quads[..., :2] * cell_um
    corners[..., 2] = height[quads[..., 2] + 1]
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    records = np.zeros(len(triangles), _RECORD)
    records["normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    records["corners"] = triangles
    with open(path, "wb") as stream:
        stream.write(b"litholoop layout, micrometres".ljust(_HEADER_BYTES))
        stream.write(np.uint32(len(records)).astype("<u4").tobytes())
        stream.write(records.tobytes())
    return len(records)


def read_stl_triangles(path: Path) -> np.ndarray:
    """Corners float32 (n, 3, 3) of a binary STL, µm.

    Raises:
        InputError: a file whose length does not fit its triangle count.
    """
    data = path.read_bytes()
    count = int(np.frombuffer(data, "<u4", 1, _HEADER_BYTES)[0]) if len(data) >= _HEADER_BYTES + 4 else -1
    if len(data) != _HEADER_BYTES + 4 + count * _RECORD.itemsize:
        raise InputError(f"STL {path}", got=f"{len(data)} bytes", wanted="a whole binary STL")
    return np.frombuffer(data, _RECORD, count, _HEADER_BYTES + 4)["corners"]


def read_stl_levels(
    path: Path, shape: tuple[int, int], cell_um: float, level_height_um: float, pedestal_um: float
) -> np.ndarray:
    """Levels per cell uint8 (ny, nx), row 0 on top, from the upward faces of the solid."""
    corners = read_stl_triangles(path).astype(np.float64)
    top = corners[(np.ptp(corners[..., 2], axis=1) == 0) & (corners[:, 0, 2] > 0)]
    centre = top.mean(1)
    column, row = (np.floor(centre[:, axis] / cell_um).astype(int) for axis in (0, 1))
    levels = np.zeros(shape, np.uint8)
    levels[shape[0] - 1 - row, column] = np.rint((centre[:, 2] - pedestal_um) / level_height_um)
    return levels


def _caps(levels: np.ndarray) -> np.ndarray:
    """Upper and lower face of every column: (2 n, 4 corners, xyz), counter-clockwise from outside."""
    y, x = (index.ravel() for index in np.indices(levels.shape))
    top = levels.ravel()
    upper = np.stack(
        [_corner(x, y, top), _corner(x + 1, y, top), _corner(x + 1, y + 1, top), _corner(x, y + 1, top)], 1
    )
    under = np.full_like(top, -1)
    lower = np.stack(
        [
            _corner(x, y, under),
            _corner(x, y + 1, under),
            _corner(x + 1, y + 1, under),
            _corner(x + 1, y, under),
        ],
        1,
    )
    return np.concatenate([upper, lower])


def _walls(levels: np.ndarray) -> np.ndarray:
    """Walls across x between neighbours of different height, one quad per level of difference."""
    padded = np.pad(levels, ((0, 0), (1, 1)), constant_values=-1)
    left, right = padded[:, :-1], padded[:, 1:]
    low, high = np.minimum(left, right), np.maximum(left, right)
    count = (high - low).ravel()
    y, x = (np.repeat(index.ravel(), count) for index in np.indices(left.shape))
    first = np.repeat(np.cumsum(count) - count, count)
    z = np.repeat(low.ravel(), count) + np.arange(count.sum()) - first
    quads = np.stack(
        [_corner(x, y, z), _corner(x, y + 1, z), _corner(x, y + 1, z + 1), _corner(x, y, z + 1)], 1
    )
    # As listed the wall faces +x, as it must where the higher column stands to the left of it.
    faces_left = np.repeat((left < right).ravel(), count)
    quads[faces_left] = quads[faces_left][:, ::-1]
    return quads


def _corner(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.stack([x, y, z], axis=-1)
