"""Clean the counts of a photograph: saturated, hot and dead pixels, and uneven light."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_design.images.targets import read_grey

# Largest allowed share of pixels clipped at the bright or dark end. A larger share would change the
# similarity.
LARGEST_SATURATED = 0.01
_HOT_SIGMAS = 6.0
# If a camera pixel contains more than this number of periods of the finest fringes, real spots are as narrow
# as hot pixels.
_COARSE = 0.25


def saturated_share(raw: np.ndarray) -> float:
    """Return the share of saturated pixels. The pixels with the highest count of the photograph are saturated
    if this count is the end of the range of 8, 10, 12, 14 or 16 bits, or if unusually many pixels have this
    count.
    """
    top = int(raw.max())
    ends = [2**bits - 1 for bits in (8, 10, 12, 14, 16)]
    at_top = float((raw == top).mean())
    # If many pixels have the highest count and few others come close to it, this count is the end of the
    # camera's range.
    beside = float(((raw < top) & (raw >= top - max(1, top // 500))).mean())
    return at_top if top in ends or at_top > max(4 * beside, LARGEST_SATURATED) else 0.0


def flattened(photo: np.ndarray, flat_file: str | Path, dark_level: float | None) -> np.ndarray:
    """Divide a photograph by a photograph of uniform light, which is scaled to a mean of 1. The dark level is
    preserved.
    """
    from scipy.ndimage import gaussian_filter

    flat = read_grey(flat_file, "photograph of uniform light")[0].astype(np.float32)
    if flat.shape != photo.shape or dark_level is None or not np.median(flat) > dark_level:
        wanted = f"{photo.shape} px, and counts above a --camera-dark-level that is also given"
        raise InputError("photograph of uniform light", got=f"{flat.shape} px", wanted=wanted)
    light = gaussian_filter(flat - dark_level, 2.0)
    even: np.ndarray = (photo - dark_level) * (light.mean() / light.clip(min=0.05 * light.max()))
    return (even + dark_level).astype(np.float32)


def without_outliers(photo: np.ndarray, finest_per_px: float) -> tuple[np.ndarray, int]:
    """Replace outliers by the median of their 3 x 3 neighbourhood. An outlier deviates from this median by
    more than a limit, which few pixels reach. If the image may contain detail almost as narrow as a pixel, an
    outlier must also lie above all of its neighbours, or below all of them, by more than the limit.
    ``finest_per_px`` is the highest spatial frequency of the image, in cycles/px.
    """
    import cv2

    lit = photo - np.percentile(photo, 1)
    median = cv2.medianBlur(lit.astype(np.float32), 3)
    difference = lit - median
    spread = 1.4826 * float(np.median(np.abs(difference))) + 1e-6 * float(lit.max())
    # The brightest value is taken from the median-filtered image, so that a hot pixel cannot determine it.
    bright = float(median.max())
    limit = np.maximum(_HOT_SIGMAS * spread, 0.5 * median + 0.05 * bright)
    outliers = np.abs(difference) > limit
    if finest_per_px > _COARSE:
        ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
        outliers &= (lit - cv2.dilate(lit, ring) > limit) | (cv2.erode(lit, ring) - lit > limit)
    return np.where(outliers, photo - difference, photo).astype(np.float32), int(outliers.sum())
