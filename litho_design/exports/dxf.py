"""Write layouts as DXF (R12, ASCII) with closed polylines. Each level has its own layer, whose name is the
grey value of the level.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from litho_design.exports.gds import rectangles
from litho_design.exports.rows import LevelRows, bands_of

_BAND_PX = 128


def write_dxf(path: Path, levels: LevelRows, pitch_um: float, greys: Sequence[int]) -> int:
    """For each level whose grey value is not 0, cover the pixels of this level with disjoint rectangles.
    Write the rectangles to a file. Coordinates are in µm, and y points upwards. Return the number of
    rectangles.
    """
    count = 0
    with open(path, "w", encoding="ascii") as stream:
        # $INSUNITS 13: micrometres.
        stream.write("0\nSECTION\n2\nHEADER\n9\n$ACADVER\n1\nAC1009\n9\n$INSUNITS\n70\n13\n0\nENDSEC\n")
        stream.write("0\nSECTION\n2\nENTITIES\n")
        for rows in bands_of(levels, _BAND_PX):
            band = levels[rows]
            drawn = [level for level in np.unique(band).tolist() if greys[level]]
            masks = band == np.array(drawn, band.dtype)[:, None, None]
            for mask, top, bottom, left, right in rectangles(masks).tolist():
                low, high = (levels.shape[0] - rows.start - edge for edge in (bottom, top))
                corners = ((left, low), (right, low), (right, high), (left, high))
                layer = greys[drawn[mask]]
                stream.write(f"0\nPOLYLINE\n8\n{layer}\n66\n1\n70\n1\n10\n0\n20\n0\n30\n0\n")
                for x, y in corners:
                    stream.write(
                        f"0\nVERTEX\n8\n{layer}\n10\n{x * pitch_um:.4f}\n20\n{y * pitch_um:.4f}\n30\n0\n"
                    )
                stream.write("0\nSEQEND\n")
                count += 1
        stream.write("0\nENDSEC\n0\nEOF\n")
    return count
