"""Find dust and scars on a scan."""

from __future__ import annotations

from typing import Any

import numpy as np

# Deviations count as dust only if they are larger than the random errors of a print, and wider than the
# deviations at a displaced step.
_DUST_BLUR_PX, _DUST_SIGMAS, _LOWEST_DUST_UM = 1.5, 7.0, 0.1
# A deviation counts as dust if the share of deviating pixels among all others with the same expected height
# is smaller than this value. Heights that differ by less than ``_LIKE_HEIGHT_UM`` count as the same.
_LARGEST_DUSTY_SHARE, _LIKE_HEIGHT_UM = 0.3, 0.005


def foreign_pixels(off_um: np.ndarray, expected_um: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return a mask of dust and scars.

    A spot of deviating pixels counts as dust if few of the other pixels with the same expected height
    deviate. If many of them deviate, the printer is the cause. If no other pixel has this expected height,
    the spot counts as dust.

    Args:
        off_um: deviation of a print from the expected print, without tilt and bow, shape (ny, nx). It is zero
            at unmeasured pixels.
        expected_um: height of the expected print, shape (ny, nx).
        valid: mask of the measured pixels, shape (ny, nx).
    """
    from scipy.ndimage import binary_dilation, gaussian_filter, label

    from litho_data.level.scars import mark_scars

    # If a step of the print is displaced by a pixel, the deviation is positive in one place and negative next
    # to it, so a blur removes it.
    smooth = gaussian_filter(off_um, _DUST_BLUR_PX)
    middle = np.median(smooth)
    spread = 1.4826 * float(np.median(np.abs(smooth - middle)))
    size_um = np.abs(smooth - middle)
    dust = (size_um > max(_DUST_SIGMAS * spread, _LOWEST_DUST_UM)) & valid
    spots, count = label(dust)
    foreign = np.zeros_like(dust)
    for spot in range(1, count + 1):
        inside = spots == spot
        core = inside & (size_um >= np.median(size_um[inside]))
        low, high = np.percentile(expected_um[core], (25, 75)) + _LIKE_HEIGHT_UM * np.array([-1, 1])
        elsewhere = (expected_um >= low) & (expected_um <= high) & valid & ~inside
        if not elsewhere.any() or dust[elsewhere].mean() < _LARGEST_DUSTY_SHARE:
            foreign |= inside
    strict: Any = {"high": 4.0, "low": 2.5, "max_width_px": 2}
    scars = mark_scars(off_um, **strict) | mark_scars(off_um.T, **strict).T
    return binary_dilation(foreign | scars, iterations=2) & valid
