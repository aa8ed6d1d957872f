"""Amplitude parameters of a surface (ISO 25178-2 names)."""

from __future__ import annotations

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record


class AmplitudeParameters(Record):
    """Amplitudes about the mean height; they hold for one pitch, field of view and levelling only.

    Args:
        sa_nm: mean absolute deviation.
        sq_nm: root mean square.
        ssk: skewness, 0 where the surface is flat.
        sku: kurtosis, 3 for a Gaussian; 0 where the surface is flat.
        sz_nm: highest minus lowest pixel.
        pixels: pixels counted.
    """

    sa_nm: float
    sq_nm: float
    ssk: float
    sku: float
    sz_nm: float
    pixels: int


def amplitude_parameters(height_um: np.ndarray, valid: np.ndarray | None = None) -> AmplitudeParameters:
    """Sa, Sq, Ssk, Sku and Sz of a levelled surface.

    Sa = mean|h|, Sq² = mean h², Ssk = mean h³ / Sq³, Sku = mean h⁴ / Sq⁴ with h about the mean.

    Args:
        height_um: levelled height, µm, any shape; NaN is left out.
        valid: pixels to count; all by default.

    Raises:
        InputError: no pixel left.
    """
    counted = np.isfinite(height_um) if valid is None else np.isfinite(height_um) & valid
    height_nm = 1e3 * height_um[counted].astype(np.float64)
    if height_nm.size == 0:
        raise InputError("surface", got="no valid pixel", wanted="at least one")
    deviation = height_nm - height_nm.mean()
    sq_nm = float(np.sqrt(np.mean(deviation**2)))
    # Rounding of the mean leaves 1e-16 of the height; below that a surface is flat.
    flat = sq_nm <= 1e-12 * max(1.0, float(np.abs(height_nm).max()))
    return AmplitudeParameters(
        sa_nm=float(np.abs(deviation).mean()),
        sq_nm=sq_nm,
        ssk=0.0 if flat else float(np.mean(deviation**3) / sq_nm**3),
        sku=0.0 if flat else float(np.mean(deviation**4) / sq_nm**4),
        sz_nm=float(np.ptp(height_nm)),
        pixels=int(height_nm.size),
    )
