"""Scores of a stated σ that need no distribution: is its size right, and does it show where errors are?"""

from __future__ import annotations

import numpy as np

_BINS = 10


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
