"""Compute the amplitude parameters of a surface (named as in ISO 25178-2), its autocorrelation, and the
uncertainty of Sq.
"""

import numpy as np
import scipy.fft

from litho_data.foundation import Array, InputError, Shape
from litho_data.foundation.results import Record


class AmplitudeParameters(Record):
    """Amplitude parameters of the deviations from the mean height. Only values from surfaces with the same
    pitch, field of view and levelling can be compared.

    Args:
        sa_nm: mean absolute deviation, nm.
        sq_nm: root mean square of the deviations, nm.
        ssk: skewness; 0 for a flat surface.
        sku: kurtosis; 3 for a Gaussian surface, 0 for a flat surface.
        sz_nm: height of the highest pixel minus height of the lowest pixel, nm.
        pixels: number of pixels used.
    """

    sa_nm: float
    sq_nm: float
    ssk: float
    sku: float
    sz_nm: float
    pixels: int


def amplitude_parameters(height_um: Array, valid: Array | None = None) -> AmplitudeParameters:
    """Return Sa, Sq, Ssk, Sku and Sz of a levelled surface.

    Sa = mean|h|, Sq² = mean h², Ssk = mean h³ / Sq³, Sku = mean h⁴ / Sq⁴, where h is the deviation of the
    height from the mean height.

    Args:
        height_um: levelled heights in µm, of any shape; NaN is ignored.
        valid: bool array that is True at the pixels to use; by default all pixels are used.

    Raises:
        InputError: there is no valid pixel.
    """
    counted = np.isfinite(height_um) if valid is None else np.isfinite(height_um) & valid
    height_nm = 1e3 * height_um[counted].astype(float)
    if height_nm.size == 0:
        raise InputError("surface", got="no valid pixel", wanted="at least one valid pixel")
    deviation = height_nm - height_nm.mean()
    sq_nm = float(np.sqrt(np.mean(deviation**2)))
    # Rounding errors of the mean are about 1e-16 of the height. A surface whose Sq is not much larger than
    # these errors counts as flat.
    flat = sq_nm <= 1e-12 * max(1.0, float(np.abs(height_nm).max()))
    return AmplitudeParameters(
        sa_nm=float(np.abs(deviation).mean()),
        sq_nm=sq_nm,
        ssk=0.0 if flat else float(np.mean(deviation**3) / sq_nm**3),
        sku=0.0 if flat else float(np.mean(deviation**4) / sq_nm**4),
        sz_nm=float(np.ptp(height_nm)),
        pixels=int(height_nm.size),
    )


def autocorrelation(height_um: Array) -> Array:
    """Return the autocorrelation of a surface, normalised to 1 at lag 0, for lags up to half the field.

    Element ``[i, j]`` of the result is the value at the lag of i rows and ``j − (nx // 2 − 1)`` columns. The
    sum of products at each lag is divided by the number of pixel pairs with this lag. The result has shape
    (ny // 2, 2 (nx // 2) − 1). For a profile of one row or column, the only lag across it is 0.

    Raises:
        InputError: the surface contains NaN, or its heights are constant.
    """
    if not np.isfinite(height_um).all():
        raise InputError("surface", got="NaN", wanted="finite heights for an autocorrelation")
    deviation = height_um.astype(float) - height_um.mean(dtype=float)
    ny, nx = deviation.shape
    padded = [scipy.fft.next_fast_len(size + size // 2, real=True) for size in (ny, nx)]
    spectrum = scipy.fft.rfft2(deviation, padded)
    products = scipy.fft.irfft2(np.abs(spectrum) ** 2, padded)
    half_y, half_x = max(1, ny // 2), max(1, nx // 2)
    rows, columns = np.arange(half_y), np.arange(1 - half_x, half_x)
    covariance = products[np.ix_(rows, columns)] / _pairs((ny, nx), rows, columns)
    if covariance[0, half_x - 1] <= 0:
        raise InputError("surface", got="constant heights", wanted="heights that vary")
    return covariance / covariance[0, half_x - 1]


def _pairs(shape: Shape, rows: Array, columns: Array) -> Array:
    """Return the number of pixel pairs with each lag, shape (rows, columns)."""
    return np.outer(shape[0] - rows, shape[1] - np.abs(columns))


def effective_samples(height_um: Array) -> float:
    """Return the effective number of samples of a surface, n_eff = pixels / Σ ρ², where ρ is the
    autocorrelation. n_eff independent heights would determine the variance as precisely as the correlated
    heights of the surface do.

    The formula holds for Gaussian surfaces, whose estimated mean square has the relative variance ``2 Σ ρ² /
    pixels``. The sum excludes lags beyond a quarter of the field, because the estimated ρ is nothing but
    noise there. The estimated ρ at each remaining lag contains noise, too. The expected square of this noise
    is Σ ρ² divided by the number of pixel pairs with this lag, and the sum is corrected for it.
    """
    correlation = autocorrelation(height_um)
    centre = correlation.shape[1] // 2
    rows = np.arange(max(1, correlation.shape[0] // 2))
    reach = min(centre, max(1, correlation.shape[1] // 4))
    columns = np.arange(-reach, reach + 1)

    def total(values: Array) -> float:
        """Sum over all lags. Positive row lags count twice, because opposite lags have equal values."""
        return float(2 * np.sum(values) - np.sum(values[0]))

    noise = 1 / _pairs(height_um.shape, rows, columns)
    # At lag 0, ρ is exactly 1.
    noise[0, reach] = 0
    summed = total(correlation[np.ix_(rows, centre + columns)] ** 2) / (1 + total(noise))
    return float(min(height_um.size, max(1.0, height_um.size / summed)))


def sq_uncertainty_nm(height_um: Array) -> float:
    """Return the standard uncertainty of Sq, in nm, that is due to the finite field.

    For Gaussian heights it is ``Sq / √(2 n_eff)``, where n_eff is the result of ``effective_samples``.
    """
    return amplitude_parameters(height_um).sq_nm / float(np.sqrt(2 * effective_samples(height_um)))
