"""Add two marks beside an element: an F, from which the orientation of the print can be seen, and a flat
witness area, on which its height can be measured.
"""

from __future__ import annotations

import math

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_design.exports.rows import LevelRows
from litho_design.printers.layout import LayoutSettings

Box = tuple[int, int, int, int]

# An F looks different in all eight orientations.
_LETTER = np.array([[1, 1, 1, 1], [1, 0, 0, 0], [1, 1, 1, 0], [1, 0, 0, 0], [1, 0, 0, 0]], np.uint8)
_STROKE_UM = 1.0
# Width of the middle part of the witness area. Its distance from the edges is at least the reach of the
# printer, so the edges do not affect its printed height.
_FLAT_UM = 4.0


class Marks(Record):
    """Positions of the element, the orientation mark and the witness area in an exported map. Each position
    is a box in pixels (first row, end row, first column, end column), where the ends are exclusive.

    ``witness_height_um`` is the predicted height of the middle of the witness area above its surroundings. It
    is predicted by the model that was used for the design.
    """

    element_px: Box
    orientation_px: Box
    witness_px: Box
    witness_level: int
    witness_height_um: float

    def parts(self) -> dict[str, Box]:
        """Return a dict of the positions of the element, the mark and the witness area."""
        return {"ELEMENT": self.element_px, "ORIENTATION": self.orientation_px, "WITNESS": self.witness_px}


def with_marks(
    levels: LevelRows, layout: LayoutSettings, guard_um: float, level_heights_um: list[float]
) -> tuple[np.ndarray, Marks]:
    """Add an F and a square of the highest level to the right of a level map of shape (size, size).

    The F, the square and the element are separated by at least the reach of the printer, so that none of them
    affects the print of another. The element, the F and the square consist of whole cells.

    Args:
        guard_um: reach of the printer, µm, i.e. the distance up to which a level affects the print.
        level_heights_um: printed height, µm, of a wide uniform field of each level.

    Returns:
        The wider map, a uint8 array of shape (size, width), and the positions of its parts.

    Raises:
        InputError: the element has too few rows for both the mark and the witness area.
    """
    cell = 1 if layout.symmetry == "radial" else layout.cell_px

    def cells(length_um: float) -> int:
        return math.ceil(length_um / layout.pitch_um / cell - 1e-6) * cell

    gap, stroke, side = cells(guard_um), cells(_STROKE_UM), cells(2 * guard_um + _FLAT_UM)
    gap = max(gap, stroke)
    letter = _LETTER.repeat(stroke, 0).repeat(stroke, 1)
    size, high = levels.shape[0], len(letter) + gap + side
    if size < high:
        raise InputError(
            "marks",
            got=f"an element of {size * layout.pitch_um:g} µm",
            wanted=f"at least {high * layout.pitch_um:g} µm, which mark and witness need",
        )
    left, top_level = size + gap, layout.levels - 1
    beside = np.zeros((size, gap + max(side, letter.shape[1])), np.uint8)
    beside[: len(letter), gap : gap + letter.shape[1]] = top_level * letter
    beside[size - side :, gap : gap + side] = top_level
    return np.concatenate([levels[:], beside], axis=1), Marks(
        element_px=(0, size, 0, size),
        orientation_px=(0, len(letter), left, left + letter.shape[1]),
        witness_px=(size - side, size, left, left + side),
        witness_level=top_level,
        witness_height_um=level_heights_um[-1] - level_heights_um[0],
    )
