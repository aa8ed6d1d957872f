"""Compare the shapes in a measured map with those in a predicted map, by the structural similarity of the
maps and by the positions of the edges.

The edges of a map are its contours at the heights halfway between nominal levels. For films, there is one
contour, at half the height of the film. Marching squares finds the contours by linear interpolation between
pixels. The maps are not smoothed, so the roughness of the measured contours is part of the error.
"""

from typing import NamedTuple

import numpy as np

from litho_data.foundation.kinds import Array
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.scoring.films import film_edge_um

SSIM_RANGE_UM = 1.2
SSIM_SIGMA_PX = 1.5
SSIM_WINDOW_PX = 11
SEARCH_UM, FILM_SEARCH_PX = 0.5, 10.0
_CANDIDATES, _MOST_HEIGHTS = 8, 24
# Half the length of the longest possible piece of a contour. The longest piece is the diagonal of a pixel.
_HALF_PIECE_PX = 0.5 * 2**0.5
SIMILARITY_TEXT = (
    f"SSIM is computed with a Gaussian window (σ {SSIM_SIGMA_PX:g} px, width {SSIM_WINDOW_PX} px) and a data "
    f"range of {SSIM_RANGE_UM:g} µm."
)
EDGES_TEXT = (
    "Edge shifts are distances from measured to predicted contours. The contours are taken at the heights "
    "halfway between nominal levels; for films, they are taken at half the height of the film. Only pieces "
    f"of contour that have a partner within {SEARCH_UM:g} µm (within {FILM_SEARCH_PX:g} px for films) are "
    "included. The counts state how many pieces of measured contours have a partner, how many have none, and "
    "how many pieces of predicted contours have none."
)


class EdgePlacement(NamedTuple):
    """The distances between measured and expected contours, and the numbers of their pieces. Each contour is
    divided into pieces that are at most as long as the diagonal of a pixel.

    A piece of a measured contour has a partner if an expected contour of the same height passes within the
    search distance, and if both maps rise to the same side of the contours. ``mean_nm`` and ``p95_nm`` are
    the mean and the 95th percentile of the distances from such pieces to their partners; both are None if no
    piece has a partner. ``matched`` and ``unmatched`` count the pieces of measured contours with and without
    a partner. ``unmatched_expected`` counts the pieces of expected contours without a partner.
    """

    mean_nm: float | None
    p95_nm: float | None
    matched: int
    unmatched: int
    unmatched_expected: int


class _Contour(NamedTuple):
    start: Array  # (n, 2) row, column, px
    along: Array  # (n, 2), with the higher side always on the same side


def similarity_of_scan(scan: PrintedScan, prediction_um: Array, residual_um: Array) -> float | None:
    """Return the structural similarity (SSIM) of the predicted and the measured map of a scan. The measured
    map without the per-scan terms is the prediction plus the residual.
    """
    return structural_similarity(prediction_um + residual_um, prediction_um)


def edges_of_scan(scan: PrintedScan, prediction_um: Array, residual_um: Array) -> EdgePlacement:
    """Compare the measured edges of a scan with the predicted edges. The measured map without the per-scan
    terms is the prediction plus the residual.

    For films, ``mean_nm`` and ``p95_nm`` always have values. If no edge has a partner, both are set to the
    search distance, because measured and predicted edges are at least that far apart. If neither map has an
    edge, both are set to 0.
    """
    measured_um = prediction_um + residual_um
    if scan.seen_by != "sem":
        heights = mid_step_heights_um(scan.levels, scan.level_height_um)
        return edge_placement(measured_um, prediction_um, heights, scan.pitch_um)
    search_um = FILM_SEARCH_PX * scan.pitch_um
    heights = np.array([film_edge_um(scan)])
    found = edge_placement(measured_um, prediction_um, heights, scan.pitch_um, search_um)
    if found.matched:
        return found
    missed_nm = NM_PER_UM * search_um if found.unmatched or found.unmatched_expected else 0.0
    return found._replace(mean_nm=missed_nm, p95_nm=missed_nm)


def structural_similarity(measured_um: Array, expected_um: Array) -> float | None:
    """Return the mean structural similarity (SSIM; Wang et al. 2004, doi:10.1109/TIP.2003.819861) of two
    maps. It is 1 for equal maps.

    The Gaussian window has the standard deviation ``SSIM_SIGMA_PX`` and the width ``SSIM_WINDOW_PX``. The
    data range is ``SSIM_RANGE_UM`` for all maps. The mean is taken over the windows that contain only scored
    pixels.

    Args:
        measured_um: measured map, µm, of shape (ny, nx). Pixels that are not scored are NaN.
        expected_um: expected map, µm, with the same shape.

    Returns:
        The mean SSIM, or None if no window contains only scored pixels.
    """
    from scipy.ndimage import minimum_filter
    from skimage.metrics import structural_similarity as ssim

    scored = np.isfinite(measured_um)
    whole = minimum_filter(scored, size=SSIM_WINDOW_PX, mode="constant", cval=0)
    if not whole.any():
        return None
    expected = np.asarray(expected_um, np.float64)
    _, similarity = ssim(
        np.where(scored, measured_um, expected),
        expected,
        data_range=SSIM_RANGE_UM,
        gaussian_weights=True,
        sigma=SSIM_SIGMA_PX,
        use_sample_covariance=False,
        full=True,
    )
    return float(similarity[whole].mean())


def edge_placement(
    measured_um: Array,
    expected_um: Array,
    heights_um: Array,
    pitch_um: float,
    search_um: float = SEARCH_UM,
) -> EdgePlacement:
    """Measure the distances between the contours of a measured and an expected map.

    Args:
        measured_um: measured map, µm, of shape (ny, nx). Pixels that are not scored are NaN; the contours of
            both maps end there.
        expected_um: expected map, µm, of shape (ny, nx).
        heights_um: heights of the contours, µm (see ``mid_step_heights_um``).
        pitch_um: pixel pitch of the maps, µm.
        search_um: largest distance between a piece of contour and its partner, µm.
    """
    expected_um = np.where(np.isfinite(measured_um), expected_um, np.nan)
    distances, missing, unexpected = [np.empty(0)], 0, 0
    for height in heights_um:
        measured, expected = _contour(measured_um, height), _contour(expected_um, height)
        found = _distance_px(measured, expected, search_um / pitch_um)
        distances.append(found[np.isfinite(found)])
        missing += int(np.isinf(found).sum())
        unexpected += int(np.isinf(_distance_px(expected, measured, search_um / pitch_um)).sum())
    every = np.concatenate(distances) * pitch_um * NM_PER_UM
    return EdgePlacement(
        mean_nm=float(every.mean()) if every.size else None,
        p95_nm=float(np.quantile(every, 0.95)) if every.size else None,
        matched=every.size,
        unmatched=missing,
        unmatched_expected=unexpected,
    )


def mid_step_heights_um(levels: int, level_height_um: float) -> Array:
    """Return the heights halfway between neighbouring nominal levels, µm. If there are more than 24 such
    heights, return 24 evenly spaced heights instead.
    """
    steps = min(levels - 1, _MOST_HEIGHTS)
    return np.arange(0.5, steps, dtype=np.float64) * ((levels - 1) / steps * level_height_um)


def _contour(map_um: Array, height_um: float) -> _Contour:
    from skimage.measure import find_contours

    lines = find_contours(np.asarray(map_um, np.float64), height_um)
    start = np.concatenate([np.empty((0, 2)), *(line[:-1] for line in lines)])
    along = np.concatenate([np.empty((0, 2)), *(np.diff(line, axis=0) for line in lines)])
    real = np.any(along != 0, axis=1)
    return _Contour(start[real], along[real])


def _distance_px(of: _Contour, to: _Contour, search_px: float) -> Array:
    """For each piece of the contour ``of``, return the distance from its middle to the nearest piece of the
    contour ``to``. Only pieces at which the map rises to the same side are compared. If there is none within
    ``search_px``, the distance is infinite.
    """
    from scipy.spatial import KDTree

    middle = of.start + of.along / 2
    if not len(to.start) or not len(middle):
        return np.full(len(middle), np.inf)
    count = min(_CANDIDATES, len(to.start))
    tree = KDTree(to.start + to.along / 2)
    nearest = tree.query(middle, k=count, distance_upper_bound=search_px + _HALF_PIECE_PX)[1]
    nearest = nearest.reshape(len(middle), count)
    candidate = np.minimum(nearest, len(to.start) - 1)
    start, along = to.start[candidate], to.along[candidate]
    offset = middle[:, None] - start
    share = np.clip((offset * along).sum(-1) / (along * along).sum(-1), 0, 1)
    distance = np.linalg.norm(offset - share[..., None] * along, axis=-1)
    same_side = (along * of.along[:, None]).sum(-1) > 0
    usable = (nearest < len(to.start)) & same_side & (distance <= search_px)
    return np.where(usable, distance, np.inf).min(axis=1)
