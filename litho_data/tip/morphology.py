"""Reconstruct a surface from its image, which was produced by a tip. The image is the surface dilated by the
shape of the tip. Eroding the image by the same shape restores the surface wherever the tip touched it.

Unmeasured pixels (NaN) are ignored.
"""

from typing import NamedTuple

import numpy as np

from litho_data.foundation import YX, Array


class Eroded(NamedTuple):
    """A reconstructed surface of shape (ny, nx). For each pixel of the surface, the int32 arrays ``row`` and
    ``column`` contain the position of the image pixel that limits the height of the surface there.

    Unmeasured image pixels (NaN) are ignored.
    """

    surface: Array
    row: Array
    column: Array


def paraboloid_erosion(image: Array, pitch_um: YX, radius_um: float) -> Eroded:
    """Return the highest surface from which a paraboloid tip would produce the given image, whose heights are
    in µm and whose shape is (ny, nx).

    ``radius_um`` is the radius of the end of the tip. Pixels that are NaN in the image are NaN in the result.
    The erosion is a minimum over all image pixels. A paraboloid is the sum of a parabola in x and one in y,
    so the minimum is taken first along one axis and then along the other.
    """
    rows = np.broadcast_to(np.arange(image.shape[0], dtype=np.int32)[:, None], image.shape)
    measured = np.isfinite(image)
    heights = np.where(measured, image, np.inf)
    steepest_um = float(np.ptp(image[measured])) if measured.any() else 0.0
    along_y, row = _erode_rows(heights.T, rows.T, steepest_um, pitch_um[0], radius_um)
    columns = np.broadcast_to(np.arange(image.shape[1], dtype=np.int32), image.shape)
    surface, column = _erode_rows(along_y.T, columns, steepest_um, pitch_um[1], radius_um)
    row = np.take_along_axis(row.T, column, axis=1)
    return Eroded(np.where(measured, surface, np.nan), row, column)


def _erode_rows(
    heights: Array, places: Array, range_um: float, pitch_um: float, radius_um: float
) -> tuple[Array, Array]:
    """Return, for each pixel, the minimum of height + distance² / (2 R) over all pixels of its row, and the
    position of the minimum.
    """
    lowest, owner = heights.copy(), places.copy()
    # At larger distances than this, the tip has risen by more than the range of heights in the image, so no
    # pixel there can be the minimum.
    reach = min(int(np.sqrt(2 * radius_um * range_um) / pitch_um) + 1, heights.shape[1] - 1)
    for step in range(1, reach + 1):
        rise = (step * pitch_um) ** 2 / (2 * radius_um)
        for to, start in ((slice(None, -step), slice(step, None)), (slice(step, None), slice(None, -step))):
            candidate = heights[:, start] + rise
            better = candidate < lowest[:, to]
            np.copyto(lowest[:, to], candidate, where=better)
            np.copyto(owner[:, to], places[:, start], where=better)
    return lowest, owner
