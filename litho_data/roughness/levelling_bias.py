"""How levelling lowers Sq: it removes some of the roughness together with the background.

Least squares on a basis Q (orthonormal over the N pixels) leaves a surface with correlation matrix C
the expected variance ``σ² (1 − tr(Qᵀ C Q) / N)``. This is exact for any polynomial background and
any autocorrelation (compare arXiv:2001.00433, which treats the same bias for polynomials).
"""

from collections.abc import Callable

import numpy as np
import scipy.fft

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array, Shape

Correlation = Callable[[Array, Array], Array]


def gaussian_correlation(length_um: float) -> Correlation:
    """``exp(−r²/T²)``: falls to 1/e at ``length_um``."""
    return lambda y_um, x_um: np.exp(-(y_um**2 + x_um**2) / length_um**2)


def exponential_correlation(length_um: float) -> Correlation:
    """``exp(−r/T)``: falls to 1/e at ``length_um``."""
    return lambda y_um, x_um: np.exp(-np.hypot(y_um, x_um) / length_um)


def retained_variance(
    shape: Shape,
    pitch_um: float,
    correlation: Correlation,
    *,
    degree: int | tuple[int, int],
) -> float:
    """Expected Sq² after polynomial levelling, divided by the true variance of the surface, 0…1.

    Sq of a levelled surface is too low by the square root of this share; divide by the root to correct.

    Args:
        shape: (ny, nx), pixels.
        pitch_um: pixel pitch, µm.
        correlation: normalised autocorrelation as a function of (y, x) lags, µm.
        degree: largest total degree (1 = plane), or largest degrees along (y, x) for independent
            degrees. Degree 0 subtracts the mean.
    """
    factors = [_orthonormal_polynomials(size, _largest(degree, axis)) for axis, size in enumerate(shape)]
    padded = [scipy.fft.next_fast_len(2 * size - 1, real=True) for size in shape]
    lags_um = [_wrapped_lags(size) * pitch_um for size in padded]
    transfer = scipy.fft.rfft2(correlation(lags_um[0][:, None], lags_um[1][None, :])).real
    removed = 0.0
    for power_y, along_y in enumerate(factors[0]):
        for power_x, along_x in enumerate(factors[1]):
            if isinstance(degree, int) and power_y + power_x > degree:
                continue
            term = np.outer(along_y, along_x)
            smeared = scipy.fft.irfft2(scipy.fft.rfft2(term, padded) * transfer, padded)
            removed += float(np.sum(term * smeared[: shape[0], : shape[1]]))
    return 1 - removed / (shape[0] * shape[1])


def retained_variance_by_rows(
    width_px: int, pitch_um: float, correlation: Correlation, *, degree: int
) -> float:
    """The same for levelling each row separately by a polynomial of ``degree`` (0 = row mean)."""
    lags_um = (np.arange(width_px)[:, None] - np.arange(width_px)[None, :]) * pitch_um
    matrix = correlation(np.zeros(()), lags_um)
    terms = _orthonormal_polynomials(width_px, degree)
    return float(1 - np.einsum("ki,ij,kj->", terms, matrix, terms) / width_px)


def _largest(degree: int | tuple[int, int], axis: int) -> int:
    largest = degree if isinstance(degree, int) else degree[axis]
    if largest < 0:
        raise InputError("degree of a levelling polynomial", got=degree, wanted="0 or more")
    return largest


def _orthonormal_polynomials(size: int, degree: int) -> Array:
    """Polynomials of degree 0…``degree``, orthonormal over ``size`` pixels, shape (degree + 1, size)."""
    if size <= degree:
        raise InputError("pixels for a polynomial", got=size, wanted=f"more than its degree {degree}")
    columns = np.polynomial.legendre.legvander(np.linspace(-1, 1, size), degree)
    orthonormal, _ = np.linalg.qr(columns)
    return orthonormal.T


def _wrapped_lags(size: int) -> Array:
    """Lags 0, 1, … and −1, −2, … in the order of a circular convolution."""
    lags = np.arange(size)
    return np.where(lags <= size // 2, lags, lags - size)
