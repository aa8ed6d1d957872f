"""Find orientation, polarity and a robust affine warp by keypoints or correlation, accurate to a
few pixels.
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
# Above this correlation, a hypothesis is accepted without matching features.
CONVINCING = 0.7
MIN_INLIERS = 30
MIN_COVERAGE = 0.5
SEARCH_BLUR_PX = 2.0


@dataclass(frozen=True)
class CoarseFit:
    """The position of the scan to within a few pixels.

    ``layout_to_oriented`` maps layout indices to indices of ``orient(scan, orientation) * polarity``.
    ``points`` is None if keypoints were not used or if too few of them match. The fit is then the shift with
    the best correlation.
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
    """Find the best coarse fit; return None if scan or layout shows no structure.

    Args:
        scan: (ny, nx) heights at the layout's pitch, with the bow removed; NaN where not measured.
        layout_level: (ny, nx) integer levels.
        smooth_layout: (ny, nx) topography predicted from the layout with a blur of ``SEARCH_BLUR_PX``.
        features: whether to match keypoints. This should be false on a repeating layout, where keypoints
            would match everywhere.
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
    """Return the best hypothesis, or the upright one if it fits about as well, as on a symmetric layout."""
    best = hypotheses[0]
    for hypothesis in hypotheses:
        upright = (hypothesis.orientation, hypothesis.polarity) == ("identity", 1)
        if upright and hypothesis.ncc > max(CONVINCING, best.ncc - TIE):
            return hypothesis
    return best


def _families(best: Hypothesis, hypotheses: list[Hypothesis]) -> list[tuple[str, int]]:
    """Return the orientations and polarities in which to look for keypoints.

    ORB features are invariant to rotation, so only the four combinations of mirroring and polarity differ.
    All four are tried if the correlation does not determine the orientation.
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
    """Fit a warp to matched keypoints; return None if the inliers are too few or too clustered."""
    points = match_features(polarity * orient(scan, orientation), layout_level, seed)
    if points is None or points.inlier.sum() < MIN_INLIERS:
        return None
    shape = scan.shape
    layout_shape = layout_level.shape
    from_family = np.linalg.inv(orientation_matrix(orientation, shape))
    to_layout = np.linalg.inv(linear_part(from_family @ points.layout_to_scan, centre(layout_shape)))
    # The keypoints may show a rotation by 90° that the correlation missed.
    found = nearest_orientation(to_layout)
    turn = orientation_matrix(found, shape) @ from_family
    warp = turn @ points.layout_to_scan
    points = replace(points, scan_points=apply_transform(turn, points.scan_points), layout_to_scan=warp)
    overlap = overlap_of(warp, layout_shape, orient(np.isfinite(scan), found))
    if points.coverage(overlap) < MIN_COVERAGE:
        return None
    return CoarseFit(found, polarity, warp, points)
