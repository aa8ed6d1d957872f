"""Figures of an image of any size, in memory or on disk, a band of rows at a time.

They have the names and meanings of ``HologramScore``; those that need the whole image at once (camera,
resolved target, uniformity) are left out.
"""

from __future__ import annotations

import math

import numpy as np

from litho_design.images.similarity import SSIM_WINDOW_PX, ssim_map
from litho_design.large.bands import Bands

_PREVIEW_PX = 1024


def image_figures(image: np.ndarray, target: np.ndarray, bands: Bands) -> dict[str, float]:
    """Figures of an image (size, size), share of the incident power, against its target in [0, 1]."""
    signal = paper = dark = power = square = both = wanted = wanted_square = lit_square = 0.0
    lit = 0
    for band in bands.own():
        share, aim = (np.asarray(one[band], np.float64) for one in (image, target))
        bright = aim > 0.5
        lit += int(bright.sum())
        signal += float(share[bright].sum())
        lit_square += float(np.square(share[bright]).sum())
        dark += float(share[~bright].sum())
        paper += float(share[aim > 0].sum())
        power += float(share.sum())
        square += float(np.square(share).sum())
        both += float((share * aim).sum())
        wanted += float(aim.sum())
        wanted_square += float(np.square(aim).sum())
    pixels = bands.size_px**2
    scale, average = both / max(square, 1e-300), both / wanted
    likeness, clipped = _likeness(image, target, scale, bands)
    mean = signal / lit
    return {
        "eff_signal": signal,
        "eff_paper": paper,
        "eff_window": power,
        "si_psnr_db": -10 * math.log10(max((wanted_square - scale * both) / pixels, 1e-30)),
        "rmse_paper": math.sqrt((square / average**2 - 2 * both / average + wanted_square) / pixels),
        "ssim": likeness,
        "clipped_share": clipped,
        "speckle_contrast": math.sqrt(max(lit_square / lit - mean**2, 0.0)) / mean,
        "background_ratio": mean / (dark / (pixels - lit)),
    }


def preview(image: np.ndarray, bands: Bands) -> np.ndarray:
    """The image reduced to about 1,024 px a side at most, by means over squares of pixels."""
    step = -(-bands.size_px // _PREVIEW_PX)
    side = bands.size_px // step
    rows = [
        np.asarray(image[row * step : (row + 1) * step, : side * step], np.float64) for row in range(side)
    ]
    return np.stack([row.reshape(step, side, step).mean((0, 2)) for row in rows])


def _likeness(image: np.ndarray, target: np.ndarray, scale: float, bands: Bands) -> tuple[float, float]:
    """SSIM at the matched scale, and the share of pixels that it clips."""
    around = SSIM_WINDOW_PX // 2
    size, total, clipped = bands.size_px, 0.0, 0
    for band in bands.own():
        first, last = max(band.start - around, 0), min(band.stop + around, size)
        seen = scale * np.asarray(image[first:last], np.float64)
        clipped += int((seen[band.start - first : band.stop - first] > 1).sum())
        found = ssim_map(np.clip(seen, 0, 1), np.asarray(target[first:last], np.float64))
        # Windows that extend over the edge of the element do not count.
        inner = slice(max(band.start, around) - first, min(band.stop, size - around) - first)
        total += float(found[inner, around : size - around].sum())
    return total / (size - 2 * around) ** 2, clipped / size**2
