"""Coarse registration without an assumption about position: matched points and a robust affine."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from litho_data.foundation.kinds import Array
from litho_data.register.bend import Bend
from litho_data.register.geometry import apply_transform
from litho_data.register.topography import fill_gaps, predicted_topography, smooth_measured

FEATURE_COUNT = 4000
FAST_THRESHOLD = 5
LAYOUT_BLUR_PX = 3.0
SCAN_BLUR_PX = 1.5
INLIER_PX = 3.0
BLOCK_PX = 96
BLOCK_SEARCH_PX = 32
_ROWS_AT_ONCE = 32


@dataclass(frozen=True)
class Correspondence:
    """Matched points and the affine that most of them agree on.

    ``layout_points`` and ``scan_points`` are (n, 2) index coordinates (x, y) of the matches, ``inlier``
    tells which agree with ``layout_to_scan`` within ``INLIER_PX``; ``hull_px2`` is the area of the layout
    inside the convex hull of the inliers; ``keypoints`` is the smaller count of the two images.
    """

    method: str
    keypoints: int
    layout_points: Array
    scan_points: Array
    inlier: Array
    layout_to_scan: Array
    hull_px2: float

    def coverage(self, overlap: Array) -> float:
        """Area spanned by the inliers as a share of the pixels where scan and layout overlap."""
        return self.hull_px2 / max(float(overlap.sum()), 1.0)

    def reprojection_px(self, layout_to_scan: Array, bend: Bend | None = None) -> float:
        """Root mean square distance of the inliers from a warp, scan pixels; of a bent scan, straightened."""
        moved = apply_transform(layout_to_scan, self.layout_points[self.inlier])
        found = self.scan_points[self.inlier]
        found = found if bend is None else bend.straighten(found)
        return float(np.sqrt(((moved - found) ** 2).sum(axis=1).mean()))


def match_features(method: str, scan: Array, layout_level: Array, seed: int) -> Correspondence | None:
    """Keypoints of both images (ORB or SIFT), cross-checked matches and a MAGSAC affine.

    Args:
        method: ``orb`` or ``sift``.
        scan: (ny, nx) heights at the layout's pitch, NaN where not measured.
        layout_level: (ny, nx) integer levels.
        seed: of the robust estimator.

    Returns:
        None if there are too few matches or no affine fits them.

    ORB: E. Rublee et al., ICCV 2011, doi:10.1109/ICCV.2011.6126544. SIFT: D. G. Lowe, IJCV 60 (2004),
    doi:10.1023/B:VISI.0000029664.99615.94. MAGSAC++: D. Barath et al., CVPR 2020,
    doi:10.1109/CVPR42600.2020.00138.
    """
    import cv2

    scan_image = _contrast_image(fill_gaps(smooth_measured(scan, SCAN_BLUR_PX)))
    layout_image = _contrast_image(predicted_topography(layout_level, LAYOUT_BLUR_PX))
    detector: Any
    if method == "orb":
        detector = cv2.ORB.create(nfeatures=FEATURE_COUNT, fastThreshold=FAST_THRESHOLD)
    else:
        detector = cv2.SIFT.create(nfeatures=FEATURE_COUNT, contrastThreshold=0.01)
    measured = np.isfinite(scan).astype(np.uint8) * 255
    scan_keys, scan_descriptors = detector.detectAndCompute(scan_image, measured)
    layout_keys, layout_descriptors = detector.detectAndCompute(layout_image, None)
    if scan_descriptors is None or layout_descriptors is None:
        return None
    if method == "orb":
        layout_index, scan_index = match_bits(layout_descriptors, scan_descriptors)
    else:
        matches = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(layout_descriptors, scan_descriptors)
        layout_index, scan_index = np.array([(m.queryIdx, m.trainIdx) for m in matches], int).reshape(-1, 2).T
    layout_points = np.array([layout_keys[k].pt for k in layout_index]).reshape(-1, 2)
    scan_points = np.array([scan_keys[k].pt for k in scan_index]).reshape(-1, 2)
    keypoints = min(len(scan_keys), len(layout_keys))
    return _robust_affine(method, keypoints, layout_points, scan_points, seed)


def match_bits(first: Array, second: Array) -> tuple[Array, Array]:
    """Cross-checked matches of binary descriptors: those of OpenCV's matcher, in a third of its time.

    Args:
        first: (n, b) uint8 with n < 65536 and b a multiple of 8; second: (m, b) alike.

    Returns:
        Indices into both arrays, one pair per match: each is the other's nearest by Hamming distance, and
        the first of several equally near ones counts.
    """
    words, other_words = first.view(np.uint64), np.ascontiguousarray(second.view(np.uint64).T)
    nearest = np.empty(len(first), dtype=np.intp)
    # Distance in the high half, row in the low half: the smallest key is the first of the nearest rows.
    least_key = np.full(len(second), np.iinfo(np.uint32).max, dtype=np.uint32)
    # A few rows at a time stay in the processor's cache.
    for start in range(0, len(first), _ROWS_AT_ONCE):
        rows = words[start : start + _ROWS_AT_ONCE]
        distance = np.zeros((len(rows), len(second)), dtype=np.uint16)
        for word, other in zip(rows.T, other_words, strict=True):
            distance += np.bitwise_count(word[:, None] ^ other)
        nearest[start : start + len(rows)] = distance.argmin(axis=1)
        keys = distance.astype(np.uint32) << 16
        keys |= np.arange(start, start + len(rows), dtype=np.uint32)[:, None]
        np.minimum(least_key, keys.min(axis=0), out=least_key)
    back = least_key & 0xFFFF
    mutual = np.flatnonzero(back[nearest] == np.arange(len(first)))
    return mutual, nearest[mutual]


def match_blocks(scan: Array, layout_level: Array, layout_to_scan: Array, seed: int) -> Correspondence | None:
    """Feature-free fallback: the best shift of every block of the layout near a predicted place.

    Args:
        layout_to_scan: 3×3 index matrix whose shift predicts where a block lies in the scan.
    """
    import cv2

    scan_image = fill_gaps(smooth_measured(scan, SCAN_BLUR_PX)).astype(np.float32)
    layout_image = predicted_topography(layout_level, SCAN_BLUR_PX)
    shift = np.rint(layout_to_scan[:2, 2]).astype(int)
    layout_points, scan_points = [], []
    for top in _block_starts(layout_level.shape[0]):
        for left in _block_starts(layout_level.shape[1]):
            block = layout_image[top : top + BLOCK_PX, left : left + BLOCK_PX]
            x, y = left + shift[0], top + shift[1]
            y0, x0 = max(0, y - BLOCK_SEARCH_PX), max(0, x - BLOCK_SEARCH_PX)
            y1, x1 = max(0, y + BLOCK_PX + BLOCK_SEARCH_PX), max(0, x + BLOCK_PX + BLOCK_SEARCH_PX)
            window = scan_image[y0:y1, x0:x1]
            if min(window.shape) < BLOCK_PX or block.std() == 0:
                continue
            score = cv2.matchTemplate(window, block, cv2.TM_CCOEFF_NORMED)
            row, column = np.unravel_index(np.argmax(score), score.shape)
            layout_points.append((left, top))
            scan_points.append((x0 + column, y0 + row))
    # A block stands for its middle: at its corner a change of scale would look like a shift.
    middle = (BLOCK_PX - 1) / 2
    layout_middles, scan_middles = (
        np.array(corners, float).reshape(-1, 2) + middle for corners in (layout_points, scan_points)
    )
    return _robust_affine("blocks", len(layout_points), layout_middles, scan_middles, seed)


def _contrast_image(image: Array) -> Array:
    """8-bit copy with local contrast equalised; used to find keypoints, never for heights."""
    import cv2

    low, high = np.percentile(image, (0.5, 99.5))
    stretched = np.clip((image - low) / max(high - low, 1e-12), 0, 1) * 255
    return cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(stretched.astype(np.uint8))


def _robust_affine(
    method: str,
    keypoints: int,
    layout_points: Array,
    scan_points: Array,
    seed: int,
) -> Correspondence | None:
    import cv2

    if len(layout_points) < 6:
        return None
    cv2.setRNGSeed(seed)
    affine, inlier = cv2.estimateAffine2D(
        layout_points, scan_points, method=cv2.USAC_MAGSAC, ransacReprojThreshold=INLIER_PX, maxIters=5000
    )
    if affine is None or not np.isfinite(affine).all():
        return None
    inlier = np.asarray(inlier).reshape(-1).astype(bool)
    if inlier.sum() < 3 or abs(np.linalg.det(affine[:, :2])) < 1e-3:
        return None
    hull_px2 = float(cv2.contourArea(cv2.convexHull(layout_points[inlier].astype(np.float32))))
    matrix = np.vstack([affine, [0.0, 0.0, 1.0]])
    return Correspondence(method, keypoints, layout_points, scan_points, inlier, matrix, hull_px2)


def _block_starts(size: int) -> Array:
    count = max(1, 2 * size // BLOCK_PX - 1)
    return np.unique(np.linspace(0, max(size - BLOCK_PX, 0), count).astype(int))
