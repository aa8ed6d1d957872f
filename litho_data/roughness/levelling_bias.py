"""Compute by how much levelling lowers the measured rms roughness Sq. Sq falls because the fitted background
also follows some of the roughness.

The background is a least-squares fit of basis functions that are orthonormal over the N pixels; they are the
columns of a matrix Q. After the background is subtracted, a surface with variance σ² and correlation matrix C
has the expected variance ``σ² (1 − tr(Qᵀ C Q) / N)``. The formula is exact for any polynomial background and
any autocorrelation. Compare arXiv:2001.00433, which treats the same bias.
"""

from collections.abc import Callable

import numpy as np
import scipy.fft

from litho_data.foundation import Array, InputError, Shape

Correlation = Callable[[Array, Array], Array]


def gaussian_correlation(length_um: float) -> Correlation:
    """Return the correlation function ``exp(−r²/T²)``, which falls to 1/e at ``length_um``."""
    return lambda y_um, x_um: np.exp(-(y_um**2 + x_um**2) / length_um**2)


def exponential_correlation(length_um: float) -> Correlation:
    """Return the correlation function ``exp(−r/T)``, which falls to 1/e at ``length_um``."""
    return lambda y_um, x_um: np.exp(-np.hypot(y_um, x_um) / length_um)


def retained_variance(
    shape: Shape,
    pitch_um: float,
    correlation: Correlation,
    *,
    degree: int | tuple[int, int],
) -> float:
    """Return the expected Sq² after polynomial levelling, as a share (0…1) of the surface's true variance.

    To correct the Sq of a levelled surface, divide it by the square root of this share.

    Args:
        shape: shape (ny, nx) of the field in pixels. If each row is levelled separately by a polynomial of
            degree n, give the shape (1, nx) and the degree (0, n).
        pitch_um: pixel pitch, µm.
        correlation: normalised autocorrelation as a function of the lags along y and along x, µm.
        degree: the largest total degree (1 = plane), or the largest independent degrees along (y, x). Degree
            0 subtracts the mean.
    """
    degrees = (degree, degree) if isinstance(degree, int) else degree
    along_y, along_x = (_orthonormal_polynomials(n, most) for n, most in zip(shape, degrees, strict=True))
    padded = [scipy.fft.next_fast_len(2 * size - 1, real=True) for size in shape]
    lags_um = np.meshgrid(*(np.fft.fftfreq(n, 1 / (n * pitch_um)) for n in padded), indexing="ij")
    transfer = scipy.fft.rfft2(correlation(*lags_um)).real
    removed = 0.0
    for power_y, power_x in np.ndindex(len(along_y), len(along_x)):
        if isinstance(degree, int) and power_y + power_x > degree:
            continue
        term = np.outer(along_y[power_y], along_x[power_x])
        smeared = scipy.fft.irfft2(scipy.fft.rfft2(term, padded) * transfer, padded)
        removed += float(np.sum(term * smeared[: shape[0], : shape[1]]))
    return 1 - removed / (shape[0] * shape[1])


def _orthonormal_polynomials(size: int, degree: int) -> Array:
    """Return orthonormal polynomials of degree 0…``degree`` on ``size`` pixels, shape (degree + 1, size)."""
    if not 0 <= degree < size:
        raise InputError("degree of a levelling polynomial", got=degree, wanted=f"0 to {size - 1}")
    columns = np.polynomial.legendre.legvander(np.linspace(-1, 1, size), degree)
    orthonormal, _ = np.linalg.qr(columns)
    return orthonormal.T
