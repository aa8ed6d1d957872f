"""Find the orientation and polarity of a scan, and a warp that is accurate to a few pixels. The scan is
correlated with the layout, and keypoints are matched where this is possible.
"""

from dataclasses import dataclass, replace

import numpy as np

from litho_data.foundation import Array
from litho_data.register.features import Correspondence, match_features
from litho_data.register.geometry import (
    apply_transform,
    centre,
    linear_part,
    nearest_orientation,
    orient,
    orientation_matrix,
    overlap_of,
)
from litho_data.register.orientation import TIE, Hypothesis, search_orientation

CLEAR_MARGIN = 0.1
# If the upright hypothesis (scan not rotated, mirrored or inverted) has a correlation above this value, it is
# chosen even if another hypothesis correlates slightly better.
CONVINCING = 0.7
MIN_INLIERS = 30
MIN_COVERAGE = 0.5
SEARCH_BLUR_PX = 2.0


@dataclass(frozen=True)
class CoarseFit:
    """The orientation, polarity and position of the scan, to within a few pixels.

    ``layout_to_oriented`` is a 3×3 matrix. It maps pixel indices of the layout to pixel indices of the
    oriented scan, ``orient(scan, orientation) * polarity``. ``points`` contains the matched keypoints. If
    keypoints were not used, or too few of them match, ``points`` is None. The matrix then contains only a
    shift, the one with the highest correlation.
    """

    orientation: str
    polarity: int
    layout_to_oriented: Array
    points: Correspondence | None

    @property
    def method(self) -> str:
        """Return the method that found the fit: ``orb`` or ``correlation``."""
        return "orb" if self.points else "correlation"


def find_coarse(
    scan: Array,
    layout_level: Array,
    smooth_layout: Array,
    *,
    features: bool,
    seed: int,
) -> CoarseFit | None:
    """Find the best coarse fit, or return None if the scan or the layout shows no structure.

    Args:
        scan: heights at the layout's pitch, with the bow removed, shape (ny, nx), NaN where not measured.
        layout_level: integer level of every layout pixel, shape (ny, nx).
        smooth_layout: topography predicted from the layout with a blur of ``SEARCH_BLUR_PX``, shape (ny, nx).
        features: whether to match keypoints. It should be false for a layout that repeats itself, because its
            keypoints match in many places.
        seed: seed of the robust estimators.
    """
    hypotheses = search_orientation(scan, smooth_layout)
    if not hypotheses:
        return None
    best = _upright_if_tied(hypotheses)
    for orientation, polarity in _families(best, hypotheses) if features else ():
        fit = _fit_features(scan, layout_level, orientation, polarity, seed)
        if fit is not None:
            return fit
    return CoarseFit(best.orientation, best.polarity, best.layout_to_oriented, None)


def _upright_if_tied(hypotheses: list[Hypothesis]) -> Hypothesis:
    """Return the best hypothesis, or the upright one (not rotated, mirrored or inverted) if it correlates
    well and nearly as well as the best. On a symmetric layout, several hypotheses fit about equally well.
    """
    best = hypotheses[0]
    for hypothesis in hypotheses:
        upright = (hypothesis.orientation, hypothesis.polarity) == ("identity", 1)
        if upright and hypothesis.ncc > max(CONVINCING, best.ncc - TIE):
            return hypothesis
    return best


def _families(best: Hypothesis, hypotheses: list[Hypothesis]) -> list[tuple[str, int]]:
    """Return the orientations and polarities in which to look for keypoints.

    If the correlation clearly determines the orientation, or if the upright hypothesis was preferred to one
    with a higher correlation, only ``best`` is returned. Otherwise, one orientation is returned for each of
    the four combinations of mirroring and polarity. One is enough, because ORB keypoints match in any
    rotation.
    """
    own = (best.orientation, best.polarity)
    rivals = [h.ncc for h in hypotheses if (h.orientation, h.polarity) != own]
    if best is not hypotheses[0] or best.ncc - max(rivals, default=-1.0) >= CLEAR_MARGIN:
        return [own]
    families: dict[tuple[int, int], tuple[str, int]] = {}
    for hypothesis in hypotheses:
        handedness = round(np.linalg.det(orientation_matrix(hypothesis.orientation, (1, 1))))
        families.setdefault((handedness, hypothesis.polarity), (hypothesis.orientation, hypothesis.polarity))
    return [*families.values()]


def _fit_features(
    scan: Array, layout_level: Array, orientation: str, polarity: int, seed: int
) -> CoarseFit | None:
    """Fit a warp to matched keypoints. Matches that agree with the warp are inliers. Return None if there are
    too few inliers, or if they cover too small a part of the field.
    """
    points = match_features(polarity * orient(scan, orientation), layout_level, seed)
    if points is None or points.inlier.sum() < MIN_INLIERS:
        return None
    shape = scan.shape
    layout_shape = layout_level.shape
    from_family = np.linalg.inv(orientation_matrix(orientation, shape))
    to_layout = np.linalg.inv(linear_part(from_family @ points.layout_to_scan, centre(layout_shape)))
    # The keypoints may show that the scan is rotated by a multiple of 90° that the correlation did not find.
    found = nearest_orientation(to_layout)
    turn = orientation_matrix(found, shape) @ from_family
    warp = turn @ points.layout_to_scan
    points = replace(points, scan_points=apply_transform(turn, points.scan_points), layout_to_scan=warp)
    overlap = overlap_of(warp, layout_shape, orient(np.isfinite(scan), found))
    if points.coverage(overlap) < MIN_COVERAGE:
        return None
    return CoarseFit(found, polarity, warp, points)
