"""Layouts as a closed solid (binary STL, µm): a height field of flat runs and steep flanks, and back."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER_BYTES = 80
# Flanks run from this share of a cell before a change of level to as far behind it.
_FLANK = 0.01


def write_stl(
    path: Path, levels: np.ndarray, cell_um: float, level_height_um: float, pedestal_um: float
) -> int:
    """Write the surface ``pedestal_um + level * level_height_um``; returns the number of triangles.

    The top is a height field: every place has one height, so that every edge has two faces, also where
    columns touch at a corner only. Runs of equal level in a row, and equal rows, are one face. Flanks are
    2 % of a cell wide instead of upright, far less than any printer resolves.

    Args:
        levels: integer levels per cell (ny, nx), row 0 on top; y grows up in the file.
        cell_um: side of one cell.
        pedestal_um: base under level 0, above 0.

    Raises:
        InputError: no pedestal: level 0 would have no volume.
    """
    if pedestal_um <= 0:
        raise InputError("pedestal_um", got=pedestal_um, wanted="a positive base for a closed solid")
    lines = _lines(levels[::-1].astype(float), cell_um)
    for line in lines:
        line[:, 2] = pedestal_um + level_height_um * line[:, 2]
    top = [_zipped(lower, upper) for lower, upper in pairwise(lines)]
    triangles = np.concatenate([*top, *_sides_and_bottom(lines)])
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
    """Levels per cell uint8 (ny, nx), row 0 on top, from the flat faces on top of the solid."""
    corners = read_stl_triangles(path).astype(np.float64)
    flat = corners[(np.ptp(corners[..., 2], axis=1) == 0) & (corners[:, 0, 2] > 0)]
    # A face covers whole cells but for its flanks; one between two rows covers none.
    first, last = (np.rint(edge[:, :2] / cell_um).astype(int) for edge in (flat.min(1), flat.max(1)))
    level = np.rint((flat[:, 0, 2] - pedestal_um) / level_height_um).astype(np.uint8)
    levels = np.zeros(shape, np.uint8)
    for (left, low), (right, high), here in zip(first, last, level, strict=True):
        levels[low:high, left:right] = here
    return levels[::-1].copy()


def _lines(levels: np.ndarray, cell_um: float) -> list[np.ndarray]:
    """Two lines of points (n, 3) along x for each run of equal rows, at its lower and its upper edge.

    z is the level; where it changes, a line has a point on either side of the change.
    """
    ny, nx = levels.shape
    starts = np.concatenate([[0], np.flatnonzero((np.diff(levels, axis=0) != 0).any(1)) + 1])
    lines = []
    for low, high in zip(starts, [*starts[1:], ny], strict=True):
        row = levels[low]
        change = np.flatnonzero(np.diff(row)) + 1
        x = np.concatenate([[0.0], np.stack([change - _FLANK, change + _FLANK], 1).ravel(), [nx]])
        z = np.repeat(row[np.concatenate([[0], change])], 2)
        for y in (low + _FLANK if low else 0.0, high - _FLANK if high < ny else float(ny)):
            lines.append(np.stack([x * cell_um, np.full_like(x, y * cell_um), z], axis=1))
    return lines


def _zipped(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Triangles (n, 3, 3) between two lines of points with the same ends, facing up."""
    # A segment of one line meets the point of the other that has been reached when it ends.
    reached_above = np.searchsorted(upper[1:, 0], lower[1:, 0], side="left")
    reached_below = np.searchsorted(lower[1:, 0], upper[1:, 0], side="right")
    on_lower = np.stack([lower[:-1], lower[1:], upper[reached_above]], 1)
    on_upper = np.stack([lower[reached_below], upper[1:], upper[:-1]], 1)
    return np.concatenate([on_lower, on_upper])


def _sides_and_bottom(lines: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two triangles below every segment of the rim, and a fan of the underside."""
    right, left = (np.stack([line[end] for line in lines]) for end in (-1, 0))
    # Counter-clockwise as seen from above; each part leaves its last point to the next.
    rim = np.concatenate([lines[0][:-1], right[:-1], lines[-1][:0:-1], left[:0:-1]])
    ahead = np.roll(rim, -1, axis=0)
    foot, foot_ahead = rim * (1, 1, 0), ahead * (1, 1, 0)
    middle = np.broadcast_to((foot.max(0) + foot.min(0)) / 2, foot.shape)
    return (
        np.stack([foot, foot_ahead, ahead], 1),
        np.stack([foot, ahead, rim], 1),
        np.stack([middle, foot_ahead, foot], 1),
    )
