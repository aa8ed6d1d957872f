"""Write layouts as GWL for Nanoscribe printers. In each slice, the pixels whose levels reach the slice are
written row by row: parallel lines fill every run of adjacent pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_design.exports.job import Gwl, PrintJob
from litho_design.exports.rows import LevelRows

# Range of the piezo of a Photonic Professional along x and y.
_PIEZO_UM = 300.0


def write_gwl(path: Path, levels: LevelRows, pitch_um: float, level_height_um: float, job: PrintJob) -> int:
    """Write a GWL file. The printer writes one field after another, each from the lowest slice of the
    pedestal (base) upwards. Return the number of lines that the laser writes.

    In height, the lines of a slice lie in the middle of the slice. Each line lies in the middle of a strip
    whose width is the hatching distance. Along x, a line extends over a run of adjacent pixels whose levels
    reach the slice, from the outer edge of the first pixel to the outer edge of the last one. The origin of x
    and y is the lower left corner of the element, and y points upwards. In galvo mode, the stage moves to the
    middle of each field, and coordinates in the field are relative to this point.

    Raises:
        InputError: the level height or the pedestal is not a multiple of the slicing distance, or the pitch
            is not a multiple of the hatching distance. The error is also raised if there are too few laser
            powers for the levels, or the element exceeds the range of the piezo.
    """
    height, width = levels.shape
    gwl, slicing_um, hatching_um = job.gwl, job.slicing_um, job.hatching_um
    thick = _whole("slices per level (level_height_um / slicing_um)", level_height_um / slicing_um)
    base = _whole("slices in the pedestal (pedestal_um / slicing_um)", job.pedestal_um / slicing_um)
    rows_per_px = _whole("hatching distances per pixel (pitch_um / hatching_um)", pitch_um / hatching_um)
    if gwl.mode == "piezo" and max(height, width) * pitch_um > _PIEZO_UM:
        size = f"an element of {max(height, width) * pitch_um:g} µm"
        raise InputError(
            "piezo mode", got=size, wanted=f"at most {_PIEZO_UM:g} µm", hint="use --gwl-mode galvo"
        )
    field_px = max(1, round(gwl.field_um / pitch_um)) if gwl.mode == "galvo" else max(height, width)
    lines, at_um = 0, np.zeros(2)
    with open(path, "w", encoding="ascii") as stream:
        stream.write(_head(gwl))
        for top, left in np.ndindex(-(-height // field_px), -(-width // field_px)):
            part = levels[top * field_px : (top + 1) * field_px][:, left * field_px : (left + 1) * field_px]
            corner_um = np.array([left * field_px, height - top * field_px - len(part)]) * pitch_um
            if gwl.mode == "galvo":
                middle_um = corner_um + np.array(part.shape[::-1]) / 2 * pitch_um
                for axis, move_um in zip("XY", (middle_um - at_um).tolist(), strict=True):
                    stream.write(f"MoveStage{axis} {move_um:.4f}\n")
                at_um, corner_um = middle_um, corner_um - middle_um
            highest = int(part.max())
            powers = _powers(gwl, highest)
            for number in range(base + thick * highest):
                level = 0 if number < base else (number - base) // thick + 1
                stream.write(f"LaserPower {powers[level]:g}\n")
                z_um = (number + 0.5) * slicing_um
                for row, begin, end in _runs(part >= level):
                    x = (corner_um[0] + begin * pitch_um, corner_um[0] + end * pitch_um)
                    for hatch in range(rows_per_px):
                        y = corner_um[1] + (len(part) - row - 1) * pitch_um + (hatch + 0.5) * hatching_um
                        stream.write(f"{x[0]:.4f} {y:.4f} {z_um:.4f}\n{x[1]:.4f} {y:.4f} {z_um:.4f}\nWrite\n")
                        lines += 1
    return lines


def _head(job: Gwl) -> str:
    mode = {"galvo": "GalvoScanMode", "piezo": "PiezoScanMode\nConnectPointsOn"}[job.mode]
    return (
        "% litholoop layout, micrometres; y up, z from the substrate\n"
        f"InvertZAxis 1\n{mode}\nContinuousMode\nPowerScaling 1\nScanSpeed {job.speed_um_s:g}\n"
        "XOffset 0\nYOffset 0\nZOffset 0\nFindInterfaceAt 0\n"
    )


def _runs(mask: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """Yield the row, the start and the end of each run of True pixels in a mask of shape (ny, nx), beginning
    with the bottom row.
    """
    edges = np.diff(np.pad(mask.astype(np.int8), ((0, 0), (1, 1))), axis=1)[::-1]
    row, begin = np.nonzero(edges > 0)
    end = np.nonzero(edges < 0)[1]
    return zip((len(mask) - 1 - row).tolist(), begin.tolist(), end.tolist(), strict=True)


def _powers(job: Gwl, highest: int) -> tuple[float, ...]:
    powers = job.power_percent
    if len(powers) == 1:
        return powers * (highest + 1)
    if len(powers) <= highest:
        raise InputError(
            "laser power",
            got=f"{len(powers)} numbers",
            wanted=f"one number, or one for the pedestal and one for each of {highest} levels",
        )
    return powers


def _whole(what: str, count: float) -> int:
    if abs(count - round(count)) > 1e-6 or round(count) < 1:
        raise InputError(what, got=f"{count:.4g}", wanted="a whole number of at least one")
    return round(count)
