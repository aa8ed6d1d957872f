"""Find the approximate position of a scan, without an initial guess, by matching keypoints and fitting a
robust affine map to the matches.
"""

from dataclasses import dataclass

import numpy as np

from litho_data.foundation import Array
from litho_data.register.bend import Bend
from litho_data.register.geometry import apply_transform
from litho_data.register.topography import fill_gaps, predicted_topography, smooth_measured

FEATURE_COUNT = 4000
FAST_THRESHOLD = 5
LAYOUT_BLUR_PX = 3.0
SCAN_BLUR_PX = 1.5
INLIER_PX = 3.0
_FEWEST_MATCHES = 6


@dataclass(frozen=True)
class Correspondence:
    """Matched keypoints of layout and scan, and the affine map with which most of them agree.

    ``layout_points`` and ``scan_points`` contain the pixel indices (x, y) of the matched keypoints, in arrays
    of shape (n, 2). ``inlier`` says which matches agree with ``layout_to_scan`` within ``INLIER_PX``.
    ``hull_px2`` is the area, in layout pixels, of the convex hull of these inliers. ``keypoints`` is the
    number of keypoints found in the layout or the number found in the scan, whichever is smaller.
    """

    keypoints: int
    layout_points: Array
    scan_points: Array
    inlier: Array
    layout_to_scan: Array
    hull_px2: float

    def coverage(self, overlap: Array) -> float:
        """Return the area of the inliers' convex hull, as a share of the area in which scan and layout
        overlap.

        ``overlap`` is the bool mask of the overlap on the layout's pixels.
        """
        return self.hull_px2 / max(float(overlap.sum()), 1.0)

    def reprojection_px(self, layout_to_scan: Array, bend: Bend | None = None) -> float:
        """Map the inliers of the layout into the scan with the warp. Return the root mean square of their
        distances, in scan pixels, from the matching inliers of the scan.

        If a bend is given, the distances are measured in the straightened scan.
        """
        moved = apply_transform(layout_to_scan, self.layout_points[self.inlier])
        found = self.scan_points[self.inlier]
        found = found if bend is None else bend.straighten(found)
        return float(np.sqrt(((moved - found) ** 2).sum(axis=1).mean()))


def match_features(scan: Array, layout_level: Array, seed: int) -> Correspondence | None:
    """Find ORB keypoints in scan and layout, match them with a cross-check, and fit an affine map to the
    matches by MAGSAC++.

    Args:
        scan: heights at the layout's pitch, shape (ny, nx), NaN where not measured.
        layout_level: integer levels, shape (ny, nx).
        seed: seed of the robust estimator.

    Returns:
        The matched keypoints, or None if there are too few of them or no affine map fits them.

    Sources: ORB: E. Rublee et al., ICCV 2011, doi:10.1109/ICCV.2011.6126544. MAGSAC++: D. Barath et al., CVPR
    2020, doi:10.1109/CVPR42600.2020.00138.
    """
    import cv2

    scan_image = _contrast_image(fill_gaps(smooth_measured(scan, SCAN_BLUR_PX)))
    layout_image = _contrast_image(predicted_topography(layout_level, LAYOUT_BLUR_PX))
    detector = cv2.ORB.create(nfeatures=FEATURE_COUNT, fastThreshold=FAST_THRESHOLD)
    measured = np.isfinite(scan).astype(np.uint8) * 255
    scan_keys, scan_descriptors = detector.detectAndCompute(scan_image, measured)
    layout_keys, layout_descriptors = detector.detectAndCompute(layout_image, None)
    if not (scan_keys and layout_keys):
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(layout_descriptors, scan_descriptors)
    if len(matches) < _FEWEST_MATCHES:
        return None
    layout_points = np.array([layout_keys[one.queryIdx].pt for one in matches])
    scan_points = np.array([scan_keys[one.trainIdx].pt for one in matches])
    cv2.setRNGSeed(seed)
    affine, inlier = cv2.estimateAffine2D(
        layout_points, scan_points, method=cv2.USAC_MAGSAC, ransacReprojThreshold=INLIER_PX, maxIters=5000
    )
    # OpenCV may return None, although its type annotations promise a matrix.
    if not np.isfinite(np.asarray(affine, dtype=float)).all():
        return None
    inlier = np.asarray(inlier).reshape(-1).astype(bool)
    if inlier.sum() < 3 or abs(np.linalg.det(affine[:, :2])) < 1e-3:
        return None
    hull_px2 = float(cv2.contourArea(cv2.convexHull(layout_points[inlier].astype(np.float32))))
    matrix = np.vstack([affine, [0.0, 0.0, 1.0]])
    keypoints = min(len(scan_keys), len(layout_keys))
    return Correspondence(keypoints, layout_points, scan_points, inlier, matrix, hull_px2)


def _contrast_image(image: Array) -> Array:
    """Return an 8-bit copy of an image with equalised local contrast. It is used only to find keypoints."""
    import cv2

    low, high = np.percentile(image, (0.5, 99.5))
    stretched = np.clip((image - low) / max(high - low, 1e-12), 0, 1) * 255
    return cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(stretched.astype(np.uint8))
