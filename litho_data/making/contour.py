"""Find the edges of a film in an electron micrograph, and convert signed distances from these edges to
heights.

In a micrograph, the film is brighter than the ground, and its rim is brightest. Charging changes the
brightness from place to place. The edge is therefore placed where the brightness is half way between the
brightness of the nearby ground and the brightness of the nearby rim. This position is a convention. The wall
of the film may lie elsewhere on the flank of the bright rim, and a micrograph cannot show where.
"""

from typing import NamedTuple

import numpy as np

from litho_data.foundation import Array, InputError

REACH_PX = 8.0
"""Distances from an edge are measured at least up to this many pixels of the micrograph."""
_NOISE_PX = 1.0
# A first edge is found with a single threshold for the whole picture, before the final edge is located.
# Pixels on the film whose distance from the first edge lies in the first range, in px, count as rim. Pixels
# off the film whose distance lies in the second range count as ground. The last value is the sigma, in px, of
# the Gaussian with which the brightness of rim and ground is averaged.
_RIM_PX, _GROUND_PX, _AROUND_PX = (2, 8), (6, 30), 40.0
# Largest distance, in px, of the final edge from the first edge.
_NEAR_PX = 5
_SPECK_PX = 40
_DARKEST = 1.0
_STEP_PX = 0.2
# An island or a gap counts as lost in printing if at most this share of its area was printed as in the
# layout.
_LOST = 0.1


class Edges(NamedTuple):
    """The edges of a film in a micrograph.

    ``distance_px`` has the shape (ny, nx) of the micrograph. It contains the signed distance of each pixel
    from the nearest edge, positive on the film. ``specks`` is a bool mask of the same shape. It marks dots
    and pinholes of at most 40 pixels, which are ignored. ``sigma_px`` is the standard deviation of an edge
    position that is determined from a single pixel.
    """

    distance_px: Array
    specks: Array
    sigma_px: float


def find_edges(grey: Array, reach_px: float = REACH_PX) -> Edges:
    """Find the edges of the film in a micrograph, to a fraction of a pixel.

    Args:
        grey: grey values of the micrograph, shape (ny, nx).
        reach_px: largest distance that is measured. Pixels farther from an edge get this distance.

    Raises:
        InputError: the micrograph shows no edges.
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter
    from scipy.spatial import cKDTree
    from skimage.filters import threshold_otsu
    from skimage.measure import find_contours
    from skimage.morphology import remove_small_holes, remove_small_objects

    smooth = gaussian_filter(np.asarray(grey, dtype=float), _NOISE_PX)
    # The threshold is found from the logarithm of the brightness, because bright rims and charging affect the
    # logarithm less.
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
    near = np.where(film, inside, outside) <= reach_px + _NEAR_PX
    reached, _ = cKDTree(points).query(np.argwhere(near), distance_upper_bound=reach_px)
    distance = np.full(smooth.shape, reach_px)
    distance[near] = np.minimum(reached, reach_px)
    slope = np.hypot(*np.gradient(smooth))[np.abs(above) < height / 4]
    noise = np.std((smooth - gaussian_filter(smooth, 2 * _NOISE_PX))[outside > _GROUND_PX[0]])
    return Edges(np.where(above > 0, distance, -distance), film != first, float(noise / np.median(slope)))


def _dense(line: Array) -> Array:
    """Return evenly spaced points along a contour. The contour and the result are arrays with the columns y
    and x and one row per point.
    """
    along = np.r_[0.0, np.hypot(*np.diff(line, axis=0).T).cumsum()]
    places = np.arange(0.0, along[-1], _STEP_PX)
    return np.stack([np.interp(places, along, line[:, axis]) for axis in (0, 1)], axis=1)


def coverage(distance_um: Array, pitch_um: float) -> Array:
    """Return the share of each pixel's area, from 0 to 1, that film covers. ``distance_um`` is the signed
    distance from the nearest edge to the centre of the pixel.
    """
    return np.clip(0.5 + distance_um / pitch_um, 0.0, 1.0)


def edge_shift_px(level: Array, distance_px: Array) -> float:
    """Return the median distance, in pixels, by which the edges of a film lie outside the edges of its
    layout. The result is negative if the film's edges lie inside.

    If a layout consists of small islands and gaps, the registration would mistake part of such a shift for a
    change of scale. It must therefore use a layout whose edges are shifted by the same distance. A shift of
    less than one pixel is negligible, and the result is then 0. It is also 0 if the film or the layout has no
    edges.

    Args:
        level: levels of the layout, shape (ny, nx).
        distance_px: signed distance of each pixel of the layout from the nearest edge of the film, positive
            on the film, NaN where not measured.
    """
    from_layout, at_edge = _distance_px(level), np.abs(distance_px) < 0.5
    if not at_edge.any() or not np.isfinite(from_layout).all():
        return 0.0
    shift = -float(np.median(from_layout[at_edge]))
    return round(shift, 3) if abs(shift) >= 1 else 0.0


def with_moved_edges(level: Array, outwards_px: float) -> Array:
    """Return the levels of the layout, as float of shape (ny, nx), with all edges moved outwards by
    ``outwards_px``. Pixels that an edge crosses have levels between 0 and the highest level.
    """
    return level.max() * coverage(_distance_px(level) + outwards_px, 1.0)


def _distance_px(level: Array) -> Array:
    """Return the signed distance of each pixel from the nearest edge of a layout, positive where the layout
    has film. It is infinite if the layout has no edge.
    """
    from scipy.ndimage import distance_transform_edt

    film = level > level.max() / 2
    if film.all() or not film.any():
        return np.full(level.shape, np.inf)
    return np.where(film, distance_transform_edt(film) - 0.5, 0.5 - distance_transform_edt(~film))


def foreign(covered: Array, layout_share: Array, depth_px: int) -> Array:
    """Return a bool mask of the defects in a print: film (dirt) far inside a gap of the layout, or bare
    ground (a pit) far inside the layout's film.

    If a gap is completely closed or an island is completely missing, this is a property of the print. It is
    not marked as a defect.

    Args:
        covered: measured share of each pixel's area that is covered by film, shape (ny, nx), NaN where not
            measured.
        layout_share: share of each pixel's area that should be covered by film according to the layout, shape
            (ny, nx).
        depth_px: distance in pixels. Deviations closer than this to an edge of the layout may belong to the
            print and are not marked. The marked defects are widened by the same distance.
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt, label, mean

    found, wrong = covered > 0.5, np.zeros(covered.shape, bool)
    for wanted in (layout_share > 0.5, layout_share <= 0.5):
        parts, count = label(wanted)
        as_wanted = np.isfinite(covered) & (found == (layout_share > 0.5))
        kept = np.r_[0.0, mean(as_wanted, parts, np.arange(1, count + 1))][parts] > _LOST
        wrong |= np.isfinite(covered) & ~as_wanted & kept & (distance_transform_edt(wanted) > depth_px)
    return binary_dilation(wrong, iterations=depth_px) if wrong.any() else wrong
