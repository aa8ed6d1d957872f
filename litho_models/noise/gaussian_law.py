"""Closed forms of a Gaussian prediction: likelihood, CRPS, coverage, and the mean absolute value.

CRPS after Gneiting and Raftery 2007, doi:10.1198/016214506000001437, equation 21 with its sign turned.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri

COVERAGE_LEVELS = (0.5, 0.8, 0.9, 0.95)
# Mean absolute value of a Gaussian of standard deviation 1.
GAUSSIAN_MAE = float(np.sqrt(2 / np.pi))


def negative_log_likelihood(residual: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """``ln σ + r²/2σ² + ½ ln 2π`` per pixel; residual and σ in one unit, which decides the zero."""
    z = residual / sigma
    return np.log(sigma) + 0.5 * z**2 + 0.5 * np.log(2 * np.pi)


def crps(residual: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """Continuous ranked probability score ``σ (z (2Φ(z) − 1) + 2φ(z) − 1/√π)``, z = r/σ, in the unit of r.

    It is the mean absolute error of a prediction that states its own spread; for σ → 0 it is |r|.
    """
    z = residual / sigma
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    return sigma * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi))


def coverage(residual: np.ndarray, sigma: np.ndarray | float, level: float) -> float:
    """Share of pixels within the central interval that should hold ``level`` of them."""
    return float(np.mean(np.abs(residual) <= half_width(level) * sigma))


def half_width(level: float) -> float:
    """Half width of the central interval of a Gaussian that holds ``level``, in standard deviations."""
    return float(ndtri(0.5 + level / 2))


def probability_below(z: np.ndarray | float) -> np.ndarray:
    """Φ(z); of a residual over its σ it is uniform on 0 ... 1 where σ is right (PIT)."""
    return ndtr(z)
