"""Compare a predicted film with a measured film by the area of the film and by missing, extra or merged
features.

A pixel belongs to the film if it is higher than half the height of the film; other pixels belong to the
ground. A feature is a connected part of the film or of the ground that has at least four pixels.
"""

from typing import NamedTuple

import numpy as np

from litho_data.foundation.kinds import Array
from litho_data.store import PrintedScan

_LEAST_PX = 4
FILMS_TEXT = (
    "The area error is the absolute difference between the predicted and the measured area of the film. "
    "Features are connected parts of film or ground of at least four pixels. Measured features that share no "
    "pixel with the prediction are missing, and predicted features that share no pixel with the measurement "
    "are extra. Films that are joined only in the prediction or only in the measurement count as merged."
)


class FilmErrors(NamedTuple):
    """The errors of a predicted film. ``area_error_percent`` is the absolute error of the predicted area, in
    percent of the measured area. It is None if the measured area is zero. The other fields count features.
    """

    area_error_percent: float | None
    missing: int
    extra: int
    merged: int


def films_of_scan(scan: PrintedScan, prediction_um: Array, residual_um: Array) -> FilmErrors:
    """Compare the film of a scan with the predicted film. The measured map, from which the per-scan terms are
    removed, is computed as prediction plus residual.
    """
    return film_errors(prediction_um + residual_um, prediction_um, film_edge_um(scan))


def film_edge_um(scan: PrintedScan) -> float:
    """Return the height of the contour that is the edge of the film, µm: half the height of the film."""
    return (scan.levels - 1) * scan.level_height_um / 2


def film_errors(measured_um: Array, expected_um: Array, edge_um: float) -> FilmErrors:
    """Compare a measured with a predicted film.

    Args:
        measured_um: measured height, µm, of shape (ny, nx). Pixels that are not scored are NaN.
        expected_um: predicted height, µm, with the same shape. It contains no NaN.
        edge_um: height of the contour that is the edge of a film, µm.
    """
    known = np.isfinite(measured_um)
    measured, expected = (known & (one > edge_um) for one in (measured_um, expected_um))
    film, ground = _partners(measured, expected), _partners(known & ~measured, known & ~expected)
    missing, extra = (sum(int((kind[side] == 0).sum()) for kind in (film, ground)) for side in (0, 1))
    area = int(measured.sum())
    return FilmErrors(
        area_error_percent=100 * abs(int(expected.sum()) - area) / area if area else None,
        missing=missing,
        extra=extra,
        merged=sum(int(np.maximum(counts - 1, 0).sum()) for counts in film),
    )


def _partners(first: Array, second: Array) -> tuple[Array, Array]:
    """Find the connected parts of two masks. For each part of one mask with at least four pixels, count the
    parts of this size in the other mask that it overlaps. If it overlaps only smaller parts, the count is 1.
    Return the counts for the parts of the first mask, and the counts for the parts of the second mask.
    """
    from scipy.ndimage import label

    labels = [label(one)[0] for one in (first, second)]
    large = [np.bincount(one.ravel())[1:] >= _LEAST_PX for one in labels]
    both = (labels[0] > 0) & (labels[1] > 0)
    pairs = np.unique(np.stack([one[both] for one in labels]), axis=1) - 1
    real = large[0][pairs[0]] & large[1][pairs[1]]
    touched, counted = (
        [np.bincount(own[kept], minlength=len(size)) for own, size in zip(pairs, large, strict=True)]
        for kept in (slice(None), real)
    )
    # With the count 1, a part that overlaps only smaller parts has a partner, but merges nothing.
    found = [
        np.where(many > 0, many, np.minimum(any_, 1)) for many, any_ in zip(counted, touched, strict=True)
    ]
    return found[0][large[0]], found[1][large[1]]
