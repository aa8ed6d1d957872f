"""Fit a camera to a photograph: its pose, gain, gamma, blur and dark level."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from litho_design.images.camera_pose import Images, blurred_images, resampled, tilted_pose

# Another printer moves the whole image of a hologram, which the scatter between the tiles of a photograph
# does not show. These are typical standard deviations of the shifts, the rotation, the scale and the tilts,
# as shares of half the window (rms over twenty holograms and five models, less the scatter between tiles).
_PRINT_MOVES_SD = np.array([0.004, 0.004, 0.0, 0.015, 0.0, 0.0])
# The dark level is found from pixels at these percentiles of brightness. The second one gives its value, and
# their spread its error.
_DARK_PERCENTS = (1, 3, 10)
# Relative standard deviation of the expected light in the darkest pixels.
_DARK_LIGHT_SD = 0.3


@dataclass(frozen=True)
class CameraFit:
    """A fitted camera.

    Attributes:
        window_to_photo: map from window pixels to photograph pixels, a matrix of shape (3, 3).
        correlation: correlation of the photograph with the expected image.
        gain, gamma, blur_px: see ``_light``. ``gamma_sd`` is the standard deviation of gamma.
        position_sd_px, scale_sd: standard deviations of the position along one axis, and of the relative
            scale.
        other_warps: see ``Photograph``.
    """

    window_to_photo: np.ndarray
    correlation: float
    gain: float = 1.0
    position_sd_px: float = math.inf
    scale_sd: float = 0.0
    gamma: float = 1.0
    gamma_sd: float = 0.0
    blur_px: float = 0.0
    other_warps: list[list[np.ndarray]] = field(default_factory=list)


def print_moves(expected: np.ndarray, others: Sequence[np.ndarray]) -> np.ndarray:
    """Return how far the image moves from printer to printer, as a covariance of the six parameters of the
    pose, px², shape (6, 6).

    The covariance is the mean over the other models. Typical movements count as those of one more model.
    ``others`` is as in ``photographed_image``.
    """
    found = [np.diag((_PRINT_MOVES_SD * len(expected) / 2) ** 2)]
    for other in others:
        images = blurred_images((other / other.max()).astype(np.float32), expected, 1.0)
        # With a relative uncertainty of 1, the scale is practically free.
        moved = tilted_pose(images, 1.0, 1.0)
        steps_px = moved.pose / images.unit
        found.append(np.outer(steps_px, steps_px) - moved.scatter_px2)
    sizes, ways = np.linalg.eigh(np.mean(found, axis=0))
    return ways * sizes.clip(0) @ ways.T


def fit_camera(
    photo: np.ndarray, expected: np.ndarray, scale: float, scale_sd: float, moves_px2: np.ndarray
) -> CameraFit:
    """Fit a camera.

    Args:
        photo: counts of a photograph, shape (ny, nx), float32.
        expected: expected light, shape (m, m), float32.
        scale: number of window pixels per photograph pixel.
        scale_sd: relative standard deviation of ``scale``. If it is 0, the scale is not fitted.
        moves_px2: see ``print_moves``.
    """
    images = blurred_images(photo, expected, scale)
    unit = images.unit
    # Without a prior of the scale, a print whose image resembles the expected one little may fit best at a
    # wrong scale. If the image shows its scale well, the prior hardly changes the fit.
    prior_sd = math.hypot(scale_sd, math.sqrt(moves_px2[3, 3]) * unit[3]) if scale_sd else 0.0
    pose, free, scatter_px2 = tilted_pose(images, scale_sd, prior_sd)
    spread = scatter_px2[np.ix_(free, free)] + moves_px2[np.ix_(free, free)]
    fitted_scale_sd = 0.0
    if scale_sd:
        # The photograph shows the scale of the camera times that of the print. Both are known to be close to
        # 1, so the most probable scale of the camera is closer to 1 (linear Bayesian update).
        share = spread[:, 3] / (spread[3, 3] + (scale_sd / unit[3]) ** 2)
        pose[free] -= share * pose[3] / unit[3] * unit[free]
        spread -= np.outer(share, spread[3])
        fitted_scale_sd = float(np.sqrt(spread[3, 3]) * unit[3])
    warp, correlation = images.warp(pose), images.correlation(pose)
    if not correlation > 0:
        return CameraFit(warp, correlation)
    variance, ways = np.linalg.eigh(spread)
    steps = np.zeros((len(free), len(pose)))
    steps[:, free] = (ways * np.sqrt(variance.clip(0))).T * unit[free]
    sharp = Images(photo, expected, scale, images.alike_px)
    return CameraFit(
        warp,
        correlation,
        other_warps=[[images.warp(pose + one), images.warp(pose - one)] for one in steps],
        position_sd_px=float(np.sqrt(np.diag(spread)[:2].mean())),
        scale_sd=fitted_scale_sd,
        **_light(sharp.seen(pose), expected, images.alike_px),
    )


def fitted_dark_level(photo: np.ndarray, expected: np.ndarray, fit: CameraFit) -> tuple[float, float]:
    """Return the dark level with which the darkest pixels have the expected brightness, and the standard
    deviation of the dark level. Window pixels outside the photograph are ignored.
    """
    import cv2

    seen: Any = resampled(photo, fit.window_to_photo, len(expected))
    # The blur is as wide as a mean over 3 × 3 camera pixels. The expected image must be averaged over the
    # same area, because its dark gaps may be as narrow.
    averaged_px = math.sqrt(2 / 3 / abs(np.linalg.det(fit.window_to_photo)))
    seen = cv2.GaussianBlur(seen, (0, 0), averaged_px)
    blurred = cv2.GaussianBlur(expected, (0, 0), math.hypot(averaged_px, max(fit.blur_px, 0.5)))
    inside = inside_photograph(fit.window_to_photo, photo.shape, len(expected))
    found, wanted = (np.percentile(one[inside], _DARK_PERCENTS) for one in (seen, blurred))
    levels = found - fit.gain * wanted
    return float(levels[1]), float(np.ptp(levels)) / 2 + _DARK_LIGHT_SD * fit.gain * float(wanted[1])


def inside_photograph(warp: np.ndarray, shape: tuple[int, ...], side: int) -> np.ndarray:
    """Return a boolean mask, shape (side, side), which is True at window pixels inside the photograph."""
    import cv2

    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(np.ones(shape[:2], np.uint8), warp, (side, side), flags=flags) > 0


def _light(seen: np.ndarray, expected: np.ndarray, alike_px: float) -> dict[str, Any]:
    """Fit the counts by least squares as background + gain * (blurred expected light)^gamma."""
    import cv2

    found = {}
    for blur_px in np.arange(0.25, 4.1, 0.25).tolist():
        light = cv2.GaussianBlur(expected, (0, 0), blur_px).clip(1e-6).ravel()
        gamma = 1.0
        for _ in range(2):
            bent = light**gamma
            matrix = np.stack([np.ones_like(light), bent, bent * np.log(light)], axis=1)
            inverse = np.linalg.inv(matrix.T @ matrix)
            part = inverse @ (matrix.T @ seen.ravel())
            left = float(np.square(seen.ravel() - matrix @ part).mean())
            gamma = float(np.clip(gamma + part[2] / part[1], 0.3, 3.0))
        plain = np.polyfit(light, seen.ravel(), 1)
        sd = math.sqrt(inverse[2, 2] * left * alike_px) / abs(part[1])
        found[left] = {"gain": float(plain[0]), "gamma": gamma, "gamma_sd": sd, "blur_px": blur_px}
    return found[min(found)]
