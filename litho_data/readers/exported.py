"""Read the levels from files that the design package exported for a printer. Each exported file has a sidecar
in the same folder. The sidecar is a JSON file that says how to read the exported file.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation import Array, Facts, InputError, Shape, damaged, file_sha256
from litho_data.foundation.files import read_text
from litho_data.readers.gds_rows import GdsRows

_SCHEMA = "litho-design/export/"
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER_BYTES = 80


def export_of(file: Path) -> dict[str, Any]:
    """Return the content of the sidecar that the design package wrote beside an exported file. The result is
    empty if the file has no such sidecar.

    Raises:
        InputError: the SHA-256 of the file differs from the SHA-256 that the sidecar states.
    """
    says = _said(path := _beside(file))
    if says and says.get("file_sha256") != file_sha256(file):
        raise InputError(
            f"layout {file}",
            got="a file that its sidecar does not describe",
            wanted=f"the file that {path} describes",
        )
    return says


def sidecar_of(file: Path) -> Path | None:
    """Return the path of the sidecar of an exported file, or None if the file has no sidecar."""
    return path if _said(path := _beside(file)) else None


def _beside(file: Path) -> Path:
    return file.with_name(f"{file.name}.json")


def _said(path: Path) -> dict[str, Any]:
    """Return the content of a sidecar. The result is empty if the file is missing or is not a sidecar."""
    try:
        says = json.loads(read_text(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return says if isinstance(says, dict) and str(says.get("schema")).startswith(_SCHEMA) else {}


def exported_levels(path: Path, says: Facts) -> Array:
    """Return the levels of the designed element, without alignment marks. The result is a uint8 array of
    shape (ny, nx), with row 0 at the top.

    Args:
        path: the exported file.
        says: the content of its sidecar, from ``export_of``.

    Raises:
        InputError: the sidecar is incomplete, or the file does not match it.
    """
    levels = exported_rows(path, says)[:]
    if marks := says.get("marks"):
        top, bottom, left, right = marks["element_px"]
        levels = levels[top:bottom, left:right].copy()
    return levels


def exported_rows(path: Path, says: Facts) -> Any:
    """Return the levels of a whole exported file, including its alignment marks. For TIFF and GDS, the result
    is an object that can be sliced by rows, and a slice reads only the requested rows. For all other formats,
    the result is an array.

    Raises:
        InputError: the sidecar is incomplete, or the file does not match it.
    """
    with damaged(f"{path}.json"):
        shape, pitch_um, step_um = tuple(says["shape_px"]), says["pitch_um"], says["level_height_um"]
        match says["format"]:
            case "stl":
                px = says.get("cell_px", 1)
                cells = shape[0] // px, shape[1] // px
                found = read_stl_levels(path, cells, px * pitch_um, step_um, says["pedestal_um"])
                return found.repeat(px, 0).repeat(px, 1)
            case "gds":
                return GdsRows(path, shape, pitch_um, says["gds_layers"])
            case "tiff":
                return TiffRows(path)
            case "gwl":
                return _gwl_levels(path, shape, pitch_um, step_um, says["pedestal_um"], says["slicing_um"])
            case "dxf":
                return _dxf_levels(path, shape, pitch_um, says["greys"])
        # Sidecars of the first schema state the step between grey values instead of the grey values.
        greys = says.get("greys") or (np.arange(says["levels"]) * says["grey_per_level"]).tolist()
        return _image_levels(path, greys)


class TiffRows:
    """The levels on the first page of a TIFF, as uint8. A slice reads only the strips of the TIFF that
    contain the requested rows.
    """

    def __init__(self, path: Path):
        import tifffile
        import zarr

        self._page: Any = zarr.open_array(tifffile.imread(path, key=0, aszarr=True), mode="r")
        self.shape: tuple[int, ...] = self._page.shape

    def __getitem__(self, rows: slice) -> Array:
        found: Array = self._page[rows].astype(np.uint8)
        return found


def _image_levels(path: Path, greys: Sequence[int]) -> Array:
    """Read the levels from an exported PNG or BMP. ``greys`` contains the grey value of each level. The
    result is a uint8 array of shape (ny, nx).

    Raises:
        InputError: the file is not an image, or it contains a grey value that is not in ``greys``.
    """
    import cv2

    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    level = np.searchsorted(greys, grey if grey is not None else [[-1]]).clip(max=len(greys) - 1)
    if grey is None or (np.array(greys)[level] != grey).any():
        raise InputError(
            f"image {path}", got="grey values between levels", wanted=f"only the grey values {list(greys)}"
        )
    return level.astype(np.uint8)


def _dxf_levels(path: Path, shape: Shape, pitch_um: float, greys: Sequence[int]) -> Array:
    """Read the levels from the closed polylines of an exported DXF. The result is a uint8 array of shape (ny,
    nx), with row 0 at the top.

    Each level has its own layer, and the name of the layer is the grey value of the level. The first point in
    the record of a polyline is not a corner and is skipped.
    """
    level_of = {grey: level for level, grey in enumerate(greys)}
    found = np.full(shape, level_of.get(0, 0), np.uint8)
    for polyline in path.read_text("ascii").split("POLYLINE")[1:]:
        corners = np.array(re.findall(r"\n10\n(.*)\n20\n(.*)", polyline)[1:], float) / pitch_um
        left, low = np.rint(corners.min(axis=0)).astype(int)
        right, high = np.rint(corners.max(axis=0)).astype(int)
        found[shape[0] - high : shape[0] - low, left:right] = level_of[int(polyline.split()[1])]
    return found


def _gwl_levels(
    path: Path, shape: Shape, pitch_um: float, level_height_um: float, pedestal_um: float, slicing_um: float
) -> Array:
    """Read the levels from an exported GWL file, by counting the slices that are written at each pixel. The
    result is a uint8 array of shape (ny, nx), with row 0 at the top.

    Raises:
        InputError: the slices at a pixel do not add up to a whole number of levels.
    """
    steps = np.zeros((shape[0], shape[1] + 1), np.int32)
    stage = {"MoveStageX": 0.0, "MoveStageY": 0.0}
    points: list[list[float]] = []
    hatched: dict[int, int] = {}
    with open(path, encoding="ascii") as stream:
        for words in (line.split() for line in stream):
            if words[0] in stage:
                stage[words[0]] += float(words[1])
            elif words[0] == "Write":
                (x0, y, _), (x1, _, _) = points
                row = shape[0] - 1 - int((y + stage["MoveStageY"]) / pitch_um)
                begin, end = (round((x + stage["MoveStageX"]) / pitch_um) for x in (x0, x1))
                steps[row, begin] += 1
                steps[row, end] -= 1
                hatched[round(1e4 * (y + stage["MoveStageY"]))] = row
                points = []
            elif words[0][0] in "-0123456789":
                points.append([float(word) for word in words])
    rows_per_px = len(hatched) / shape[0]
    slices = steps.cumsum(1)[:, :-1] / rows_per_px - pedestal_um / slicing_um
    found = slices * slicing_um / level_height_um
    if np.abs(found - np.rint(found)).max() > 1e-6:
        raise InputError(f"GWL {path}", got="columns that end between two levels", wanted="whole levels")
    return np.rint(found).astype(np.uint8)


def read_stl_triangles(path: Path) -> Array:
    """Return the corners of the n triangles in a binary STL, in µm. The result is a float32 array of shape
    (n, 3, 3), indexed by triangle, corner and coordinate.

    Raises:
        InputError: the length of the file does not match the number of triangles that it states.
    """
    data = path.read_bytes()
    count = (
        int(np.frombuffer(data, "<u4", 1, _STL_HEADER_BYTES)[0]) if len(data) >= _STL_HEADER_BYTES + 4 else -1
    )
    if len(data) != _STL_HEADER_BYTES + 4 + count * _STL.itemsize:
        raise InputError(f"STL {path}", got=f"{len(data)} bytes", wanted="a complete binary STL")
    return np.frombuffer(data, _STL, count, _STL_HEADER_BYTES + 4)["corners"]


def read_stl_levels(
    path: Path, shape: Shape, cell_um: float, level_height_um: float, pedestal_um: float
) -> Array:
    """Read the levels of the cells in an exported STL, from the heights of the solid's upper faces. The
    result is a uint8 array of shape (ny, nx), with row 0 at the top.

    In such a file, no face extends over more than one cell. ``cell_um`` is the side of a cell.

    Raises:
        InputError: a cell has no upper face.
    """
    corners = read_stl_triangles(path).astype(np.float64)
    flat = corners[(np.ptp(corners[..., 2], axis=1) == 0) & (corners[:, 0, 2] > 0)]
    column, row = np.floor(flat[..., :2].mean(axis=1) / cell_um).astype(int).T
    found = np.full(shape, -1)
    found[shape[0] - 1 - row, column] = np.rint((flat[:, 0, 2] - pedestal_um) / level_height_um)
    if found.min() < 0:
        raise InputError(f"STL {path}", got="a cell without a top face", wanted="a top face for every cell")
    return found.astype(np.uint8)
