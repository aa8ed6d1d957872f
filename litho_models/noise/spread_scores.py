"""Scores of a stated σ: closed forms for a Gaussian prediction, and two that need no distribution.

CRPS after Gneiting and Raftery 2007, doi:10.1198/016214506000001437, equation 21 with its sign turned.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri

COVERAGE_LEVELS = (0.5, 0.8, 0.9, 0.95)
# Mean absolute value of a Gaussian of standard deviation 1.
GAUSSIAN_MAE = float(np.sqrt(2 / np.pi))
_BINS = 10


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


def normalised_calibration_error(residual: np.ndarray, sigma: np.ndarray, bins: int = _BINS) -> float:
    """ENCE: mean over bins of σ of ``|rms σ − rms r| / rms σ``.

    Levi, Gispan, Giladi and Fetaya 2022, doi:10.3390/s22155540. Bins hold equal counts; pixels of one σ stay
    in one bin, so that a constant σ has one. Chance leaves about ``1/√(π n)`` for n independent pixels a bin.

    Args:
        residual, sigma: (pixels,), one unit.
    """
    limits = np.unique(np.quantile(sigma, np.linspace(0, 1, bins + 1)))
    number = np.searchsorted(limits[1:-1], sigma, side="right")
    count = np.bincount(number)
    used = count > 0
    stated, there = (np.sqrt(np.bincount(number, part**2)[used] / count[used]) for part in (sigma, residual))
    return float(np.mean(np.abs(stated - there) / stated))


def sparsification_error(residual: np.ndarray, sigma: np.ndarray) -> float:
    """AUSE: what the mean ``|r|`` is above the best possible while the pixels of largest σ are taken away.

    Area between the two curves over the share taken away, 0 to 1, in units of the mean ``|r|`` of all pixels;
    0 where σ orders the pixels as ``|r|`` does. Ilg et al. 2018, arXiv:1802.07095. Pixels of one σ count with
    their mean, as in any order of them.

    Args:
        residual, sigma: (pixels,), one unit; not all residuals zero.
    """
    error = np.abs(residual)
    value, group = np.unique(sigma, return_inverse=True)
    of_group = np.bincount(group, error, minlength=len(value)) / np.bincount(group, minlength=len(value))
    kept = np.arange(1, error.size + 1)
    by_sigma, best = (np.cumsum(ordered) / kept for ordered in (of_group[np.sort(group)], np.sort(error)))
    return float(np.mean(by_sigma - best) / error.mean())
