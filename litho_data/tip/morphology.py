"""Find the surface behind an image: a tip dilates what it scans, and eroding the image by the tip restores
the surface.

Unmeasured pixels (NaN) are ignored.
"""

from typing import NamedTuple

import numpy as np

from litho_data.foundation import YX, Array


class Eroded(NamedTuple):
    """A surface (ny, nx), and row and column (int32) of the pixel that sets each height. NaN pixels set no
    height.
    """

    surface: Array
    row: Array
    column: Array


def paraboloid_erosion(image: Array, pitch_um: YX, radius_um: float) -> Eroded:
    """Return the highest surface that explains an image (ny, nx), µm, under a paraboloid tip of radius R, µm.

    A paraboloid is the sum of two parabolas, so the minimum is taken along one axis after the other. NaN
    stays NaN.
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
    """Return the lowest value of height + distance²/2R along rows, and the position of the pixel that gives
    it.
    """
    lowest, owner = heights.copy(), places.copy()
    # Farther away the tip is higher than the whole image.
    reach = min(int(np.sqrt(2 * radius_um * range_um) / pitch_um) + 1, heights.shape[1] - 1)
    for step in range(1, reach + 1):
        rise = (step * pitch_um) ** 2 / (2 * radius_um)
        for to, start in ((slice(None, -step), slice(step, None)), (slice(step, None), slice(None, -step))):
            candidate = heights[:, start] + rise
            better = candidate < lowest[:, to]
            np.copyto(lowest[:, to], candidate, where=better)
            np.copyto(owner[:, to], places[:, start], where=better)
    return lowest, owner
