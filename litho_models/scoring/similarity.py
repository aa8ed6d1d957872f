"""Structural similarity of a measured and an expected map, with the window and the range stated."""

from __future__ import annotations

import numpy as np

SSIM_RANGE_UM = 1.2
SSIM_SIGMA_PX = 1.5
SSIM_WINDOW_PX = 11


def structural_similarity(measured_um: np.ndarray, expected_um: np.ndarray) -> float | None:
    """Mean SSIM (Wang et al. 2004, doi:10.1109/TIP.2003.819861): 1 for equal maps.

    Gaussian window of standard deviation ``SSIM_SIGMA_PX``, ``SSIM_WINDOW_PX`` wide; data range
    ``SSIM_RANGE_UM`` whatever the maps hold. Only windows that lie within the scored pixels count.

    Args:
        measured_um: (ny, nx) µm, NaN where not scored; ``expected_um``: the same shape.

    Returns:
        None where no window lies within the scored pixels.
    """
    from scipy.ndimage import minimum_filter
    from skimage.metrics import structural_similarity as ssim

    scored = np.isfinite(measured_um)
    whole = minimum_filter(scored, size=SSIM_WINDOW_PX, mode="constant", cval=0)
    if not whole.any():
        return None
    expected = np.asarray(expected_um, np.float64)
    _, similarity = ssim(
        np.where(scored, measured_um, expected),
        expected,
        data_range=SSIM_RANGE_UM,
        gaussian_weights=True,
        sigma=SSIM_SIGMA_PX,
        use_sample_covariance=False,
        full=True,
    )
    return float(similarity[whole].mean())
