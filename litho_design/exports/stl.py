"""Layouts as a closed solid (binary STL, µm)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_design.exports.step_solid import step_solid

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER_BYTES = 80


def write_stl(
    path: Path, levels: np.ndarray, cell_um: float, level_height_um: float, pedestal_um: float
) -> int:
    """Write the surface ``pedestal_um + level * level_height_um``; returns the number of triangles.

    Every edge has two faces, also where columns touch along an edge only, see ``step_solid``.

    Args:
        levels: integer levels per cell (ny, nx), row 0 on top; y grows up in the file.
        cell_um: side of one cell.
        pedestal_um: base under level 0, above 0.

    Raises:
        InputError: no pedestal: level 0 would have no volume.
    """
    if pedestal_um <= 0:
        raise InputError("pedestal_um", got=pedestal_um, wanted="a positive base for a closed solid")
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
