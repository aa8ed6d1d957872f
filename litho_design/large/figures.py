"""Score an image of any size, in memory or on disk, one band of rows at a time.

The scores have the same names and meanings as in ``HologramScore``. Three kinds of scores need the whole
image at once and are omitted: the score of the camera image, scores relative to the target blurred to the
resolution of the element, and the uniformity.
"""

from __future__ import annotations

import math

import numpy as np

from litho_design.images.similarity import SSIM_WINDOW_PX, ssim_map
from litho_design.large.bands import Bands


def image_figures(image: np.ndarray, target: np.ndarray, bands: Bands) -> dict[str, float]:
    """Compare an image with its target, and return the scores, keyed by name. Image and target have shape
    (size, size). The image gives the share of the incident power on each pixel, and the target has values in
    [0, 1].
    """
    sums = np.sum([_sums(*_read(image, target, band)) for band in bands.own()], axis=0)
    lit, signal, lit_square, dark, paper, power, square, both, wanted, wanted_square = sums.tolist()
    pixels, mean = bands.size_px**2, signal / lit
    scale, average = both / max(square, 1e-300), both / wanted
    likeness, clipped = _likeness(image, target, scale, bands)
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


def _read(image: np.ndarray, target: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(image[rows], np.float64), np.asarray(target[rows], np.float64)


def _sums(share: np.ndarray, aim: np.ndarray) -> list[float]:
    """Return sums over a band of rows, from which the scores of the whole image are computed."""
    bright = aim > 0.5
    lit = share[bright]
    maps = lit, lit**2, share[~bright], share[aim > 0], share, share**2, share * aim, aim, aim**2
    return [bright.sum(), *(one.sum() for one in maps)]


def _likeness(image: np.ndarray, target: np.ndarray, scale: float, bands: Bands) -> tuple[float, float]:
    """Return the SSIM of the image multiplied by ``scale``, and the share of pixels that exceed 1 after this
    multiplication and are clipped.
    """
    around = SSIM_WINDOW_PX // 2
    size, total, clipped = bands.size_px, 0.0, 0
    for band in bands.own():
        first, last = max(band.start - around, 0), min(band.stop + around, size)
        seen, aim = _read(image, target, slice(first, last))
        seen *= scale
        clipped += int((seen[band.start - first : band.stop - first] > 1).sum())
        # Pixels whose window extends beyond the edge of the element are left out.
        inner = slice(max(band.start, around) - first, min(band.stop, size - around) - first)
        total += float(ssim_map(seen.clip(0, 1), aim)[inner, around : size - around].sum())
    return total / (size - 2 * around) ** 2, clipped / size**2
