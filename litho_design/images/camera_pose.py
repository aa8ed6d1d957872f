"""Fit the pose of a camera, so that its photograph of the expected image is as close as possible."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import correlate

from litho_design.images.noise import covariance_by_tiles

# Standard deviation of the tilts that a camera may plausibly have. A tilt is the relative change of scale
# over half the window.
_TILT_SD = 0.1
# The fit ends when a step reduces the sum of squares by less than this share. The first value is accurate
# enough for a correlation.
_ROUGH, _ACCURATE = 1e-4, 1e-8


@dataclass(frozen=True)
class Images:
    """A photograph of shape (ny, nx) and the expected image of shape (m, m) to which it is fitted. Both are
    blurred.

    The pose of a camera consists of a shift (two values, px), a rotation, the logarithm of the scale, and two
    tilts. ``scale`` is the number of window pixels per photograph pixel if this logarithm is 0. The blur
    correlates neighbouring residuals, so ``alike_px`` pixels count as one independent pixel.
    """

    photo: Any
    expected: Any
    scale: float
    alike_px: float

    @property
    def unit(self) -> np.ndarray:
        """Changes of the six parameters of a pose that move the edge of the window by one pixel."""
        return np.array([1, 1, *[2 / len(self.expected)] * 4])

    def blurred(self, width_px: float) -> Self:
        """Blur both images with a Gaussian whose standard deviation is ``width_px`` window pixels."""
        import cv2

        photo = cv2.GaussianBlur(self.photo, (0, 0), width_px / self.scale)
        expected = cv2.GaussianBlur(self.expected, (0, 0), width_px)
        return type(self)(photo, expected, self.scale, self.alike_px)

    def warp(self, pose: np.ndarray) -> np.ndarray:
        """Return the map from window pixels to photograph pixels, a matrix of shape (3, 3)."""
        turn, size, half = pose[2], math.exp(-pose[3]) / self.scale, (len(self.expected) - 1) / 2
        centre = (np.array(self.photo.shape[1::-1]) - 1) / 2
        cos, sin = size * math.cos(turn), size * math.sin(turn)
        linear = np.array([[cos, -sin, centre[0]], [sin, cos, centre[1]], [0, 0, 1]])
        tilted = np.array([[1, 0, 0], [0, 1, 0], [pose[4] / half, pose[5] / half, 1]])
        start = np.array([[1, 0, pose[0] - half], [0, 1, pose[1] - half], [0, 0, 1]])
        return linear @ tilted @ start

    def seen(self, pose: np.ndarray) -> np.ndarray:
        """Resample the photograph on the pixels of the window, shape (m, m)."""
        return resampled(self.photo, self.warp(pose), len(self.expected)).astype(np.float64)

    def correlation(self, pose: np.ndarray) -> float:
        return float(np.corrcoef(self.seen(pose).ravel(), self.expected.ravel())[0, 1])

    def fitted(self, start: np.ndarray, free: list[int], known: dict[int, float], end: float) -> Any:
        """Fit the parameters ``free`` of the pose. ``known`` contains standard deviations of parameters that
        are known to be close to 0. Return the pose and the result of scipy.
        """
        unit, model = self.unit[free], self.expected
        target = (model - model.mean()) / model.std()

        def moved(step: np.ndarray) -> np.ndarray:
            pose = start.copy()
            pose[free] += step * unit
            return pose

        def residual(step: np.ndarray) -> np.ndarray:
            pose = moved(step)
            one = self.seen(pose)
            off = (one - one.mean()) / max(float(one.std()), 1e-12) - target
            prior = [pose[column] / sd for column, sd in known.items()]
            return np.append(off.ravel() / math.sqrt(self.alike_px), prior)

        def slopes(step: np.ndarray) -> np.ndarray:
            # The derivatives use steps of half a pixel, because cv2 resolves positions only to 1/32 of a
            # pixel.
            ways = 0.5 * np.eye(len(free))
            return np.stack([residual(step + way) - residual(step - way) for way in ways], axis=1)

        found = least_squares(
            residual, np.zeros(len(free)), jac=slopes, method="lm", max_nfev=60, ftol=end, xtol=end
        )
        return moved(found.x), found


class Pose(NamedTuple):
    """A fitted pose, its free parameters, and the covariance of their scatter between tiles, px²."""

    pose: np.ndarray
    free: list[int]
    scatter_px2: np.ndarray


def resampled(photo: np.ndarray, warp: np.ndarray, side: int, *, sharp: bool = False) -> np.ndarray:
    """Interpolate a photograph at the pixels of the window, shape (side, side). ``sharp`` keeps fine detail.
    ``warp`` maps window pixels to photograph pixels.
    """
    import cv2

    kind = cv2.INTER_LANCZOS4 if sharp else cv2.INTER_LINEAR
    way: Any = {"flags": kind | cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REPLICATE}
    return cv2.warpPerspective(photo, warp, (side, side), **way)


def blurred_images(photo: Any, expected: Any, scale: float) -> Images:
    """Blur a photograph and the expected image, so that the noise of single pixels does not affect a fit."""
    blur_px = 2 * max(1.0, scale)
    return Images(photo, expected, scale, 4 * math.pi * blur_px**2).blurred(blur_px)


def best_correlation(photo: np.ndarray, expected: np.ndarray, scale: float, scale_sd: float) -> float:
    """Return the correlation of a photograph with the expected image after position and rotation are fitted,
    and the scale if its standard deviation is not 0.
    """
    images = blurred_images(photo, expected, scale)
    return images.correlation(_upright_pose(images, scale_sd, _ROUGH))


def tilted_pose(images: Images, scale_sd: float, prior_sd: float) -> Pose:
    """Fit the pose of a camera that may be tilted. ``prior_sd`` replaces ``scale_sd`` in the last fit."""
    free = [0, 1, 2, *([3] if scale_sd else []), 4, 5]
    known = {4: _TILT_SD, 5: _TILT_SD} | ({3: prior_sd} if scale_sd else {})
    pose, found = images.fitted(_upright_pose(images, scale_sd, _ACCURATE), free, known, _ACCURATE)
    scatter_px2 = np.zeros((6, 6))
    scatter_px2[np.ix_(free, free)] = covariance_by_tiles(found.jac, found.fun, images.expected.shape)
    return Pose(pose, free, scatter_px2)


def _upright_pose(images: Images, scale_sd: float, end: float) -> np.ndarray:
    """Fit position and rotation, and the scale if its standard deviation is not 0."""
    pose, (free, known) = np.zeros(6), (([0, 1, 2, 3], {3: scale_sd}) if scale_sd else ([0, 1, 2], {}))
    pose[:2] = _shift_px(images.expected, images.seen(pose))
    blur_px = math.sqrt(images.alike_px / (4 * math.pi))
    # The fit starts with more strongly blurred images. With their fine structure, it could end in a false
    # optimum next to the right one.
    for one in (images.blurred(4 * blur_px), images):
        pose, _ = one.fitted(pose, free, known, end)
    return pose


def _shift_px(reference: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Return the shift (x, y) of the image ``moving``, in whole pixels, at which its correlation with the
    image ``reference`` is largest. Both images have shape (n, n).
    """
    correlation = correlate(moving - moving.mean(), reference - reference.mean(), method="fft")
    y, x = np.unravel_index(int(correlation.argmax()), correlation.shape)
    return np.array([x, y]) - (len(reference) - 1)
