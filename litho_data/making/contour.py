"""Find the edges of a film in an electron micrograph as signed distances, and convert them to heights.

The film is bright, its rim is brightest, and charging distorts both. The edge is placed half way between the
local brightness of the ground and that of the rim. This position is a convention: the wall of the film may
lie at another point on the flank of the rim, and a micrograph cannot show where.
"""

from typing import NamedTuple

import numpy as np

from litho_data.foundation import Array, InputError

REACH_PX = 8.0
"""Distances are clipped to this many pixels of the micrograph."""
_NOISE_PX = 1.0
# Distances from the first edge, px, that count as rim and as ground, and the sigma of their local means.
_RIM_PX, _GROUND_PX, _AROUND_PX = (2, 8), (6, 30), 40.0
# Largest distance from the first edge; this edge comes from one threshold for the whole picture.
_NEAR_PX = 5
_SPECK_PX = 40
_DARKEST = 1.0
_STEP_PX = 0.2
# A part of the layout counts as lost if at most this share of it was printed.
_LOST = 0.1


class Edges(NamedTuple):
    """``distance_px`` (ny, nx) is the distance from the nearest edge, positive on the film; ``sigma_px`` is
    its standard deviation at a pixel.

    ``specks``, bool (ny, nx), marks dots and pinholes of at most 40 px, which are ignored.
    """

    distance_px: Array
    specks: Array
    sigma_px: float


def find_edges(grey: Array) -> Edges:
    """Find the edges of the film in a micrograph (ny, nx), to a fraction of a pixel.

    Raises:
        InputError: the picture has no edges.
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter
    from scipy.spatial import cKDTree
    from skimage.filters import threshold_otsu
    from skimage.measure import find_contours
    from skimage.morphology import remove_small_holes, remove_small_objects

    smooth = gaussian_filter(np.asarray(grey, dtype=float), _NOISE_PX)
    # The threshold is applied to logarithms, so that bright rims and charging count for less.
    logarithm = np.log(smooth + _DARKEST)
    first = logarithm > threshold_otsu(logarithm)
    film = remove_small_holes(remove_small_objects(first, max_size=_SPECK_PX), max_size=_SPECK_PX)
    if film.all() or not film.any():
        raise InputError("micrograph", got="no edge", wanted="bright film on dark ground, or the reverse")
    inside, outside = distance_transform_edt(film), distance_transform_edt(~film)

    def around(distance: Array, zone: tuple[int, int]) -> Array:
        weight = ((distance > zone[0]) & (distance <= zone[1])).astype(float)
        total, share = (gaussian_filter(one, _AROUND_PX) for one in (weight * smooth, weight))
        return total / np.maximum(share, 1e-12)

    above = smooth - (around(inside, _RIM_PX) + around(outside, _GROUND_PX)) / 2
    height = float(np.abs(above).max())
    above = np.where(inside > _NEAR_PX, height, np.where(outside > _NEAR_PX, -height, above))
    lines = find_contours(above, 0.0)
    if not lines:
        raise InputError("micrograph", got="no edge", wanted="bright film on dark ground, or the reverse")
    points = np.concatenate([_dense(line) for line in lines])
    near = np.where(film, inside, outside) <= REACH_PX + _NEAR_PX
    reached, _ = cKDTree(points).query(np.argwhere(near), distance_upper_bound=REACH_PX)
    distance = np.full(smooth.shape, REACH_PX)
    distance[near] = np.minimum(reached, REACH_PX)
    slope = np.hypot(*np.gradient(smooth))[np.abs(above) < height / 4]
    noise = np.std((smooth - gaussian_filter(smooth, 2 * _NOISE_PX))[outside > _GROUND_PX[0]])
    return Edges(np.where(above > 0, distance, -distance), film != first, float(noise / np.median(slope)))


def _dense(line: Array) -> Array:
    """Return evenly spaced points along a contour (n, 2)."""
    along = np.r_[0.0, np.hypot(*np.diff(line, axis=0).T).cumsum()]
    places = np.arange(0.0, along[-1], _STEP_PX)
    return np.stack([np.interp(places, along, line[:, axis]) for axis in (0, 1)], axis=1)


def coverage(distance_um: Array, pitch_um: float) -> Array:
    """Return the fraction of each pixel (0 to 1) that is covered by film, given the signed distance from the
    centre of the pixel to an edge.
    """
    return np.clip(0.5 + distance_um / pitch_um, 0.0, 1.0)


def edge_shift_px(level: Array, distance_px: Array) -> float:
    """Return how far outwards the edges of a film lie from those of its layout: the median over the film's
    edges.

    If the edges of small islands and gaps move, a registration takes part of the shift for a change of scale,
    so it needs a layout whose edges have moved too. A shift of less than one pixel is negligible and becomes
    0, and so does that of a film or layout without edges.

    Args:
        level: (ny, nx) levels of the layout.
        distance_px: distance from the edge of the film at each pixel of the layout, NaN where not seen.
    """
    from_layout, at_edge = _distance_px(level), np.abs(distance_px) < 0.5
    if not at_edge.any() or not np.isfinite(from_layout).all():
        return 0.0
    shift = -float(np.median(from_layout[at_edge]))
    return round(shift, 3) if abs(shift) >= 1 else 0.0


def with_moved_edges(level: Array, outwards_px: float) -> Array:
    """Return the layout, float (ny, nx), with its edges moved; pixels at an edge have levels in between."""
    return level.max() * coverage(_distance_px(level) + outwards_px, 1.0)


def _distance_px(level: Array) -> Array:
    """Return the distance of each pixel from the nearest edge of a layout, positive on the film; infinite if
    there is no edge.
    """
    from scipy.ndimage import distance_transform_edt

    film = level > level.max() / 2
    if film.all() or not film.any():
        return np.full(level.shape, np.inf)
    return np.where(film, distance_transform_edt(film) - 0.5, 0.5 - distance_transform_edt(~film))


def foreign(covered: Array, layout_share: Array, depth_px: int) -> Array:
    """Mark defects in a micrograph: film far inside a gap of the layout, or a pit in the film.

    A gap that is completely closed, or an island that is completely lost, is part of the print and not a
    defect.

    Args:
        covered: measured coverage by film (ny, nx), NaN where not seen.
        layout_share: coverage by film according to the layout.
        depth_px: deviations within this distance of an edge of the layout may belong to the print and are not
            defects. The marked defects are widened by the same distance.
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt, label, mean

    found, wrong = covered > 0.5, np.zeros(covered.shape, bool)
    for wanted in (layout_share > 0.5, layout_share <= 0.5):
        parts, count = label(wanted)
        as_wanted = np.isfinite(covered) & (found == (layout_share > 0.5))
        kept = np.r_[0.0, mean(as_wanted, parts, np.arange(1, count + 1))][parts] > _LOST
        wrong |= np.isfinite(covered) & ~as_wanted & kept & (distance_transform_edt(wanted) > depth_px)
    return binary_dilation(wrong, iterations=depth_px) if wrong.any() else wrong
