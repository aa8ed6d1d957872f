"""Scores of a stated spread: closed forms for a Gaussian or Student's t, and two that need no distribution.

CRPS of a Gaussian after Gneiting and Raftery 2007, doi:10.1198/016214506000001437, equation 21 with its sign
turned.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import betaln
from scipy.stats import t as student

from litho_data.foundation.kinds import Array

COVERAGE_LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95)
_BINS = 10


@dataclass(frozen=True)
class Tails:
    """Shape of a residual over its scale: Student's t, a Gaussian for ``freedom`` = ∞."""

    freedom: float = float("inf")

    def log_likelihood(self, residual: Array, scale: Array | float) -> Array:
        """Log density per pixel; its zero depends on the common unit of residual and scale."""
        return student.logpdf(residual / scale, self.freedom) - np.log(scale)

    def weight(self, z2: Array) -> Array | float:
        """−2 d log density / d z²: how much a squared residual counts, 1 for a Gaussian."""
        return 1.0 if np.isinf(self.freedom) else (self.freedom + 1) / (self.freedom + z2)

    @property
    def information(self) -> float:
        """Fisher information of a pixel about the logarithm of the squared scale."""
        return 0.5 if np.isinf(self.freedom) else 0.5 * self.freedom / (self.freedom + 3)

    @property
    def sd(self) -> float:
        """Standard deviation over the scale; it takes more than two degrees of freedom."""
        return float(student.std(self.freedom))

    def probability_below(self, z: Array | float) -> Array:
        """Probability below z; uniform for residuals over their scale if scale and shape are right (PIT)."""
        return student.cdf(z, self.freedom)

    def half_width(self, level: float) -> float:
        """Half width of the central interval that holds ``level``, over the scale."""
        return float(student.ppf(0.5 + level / 2, self.freedom))

    def covered(self, residual: Array, scale: Array | float, level: float) -> Array:
        """Whether each pixel lies within the central interval that should hold ``level`` of them."""
        return np.abs(residual) <= self.half_width(level) * scale

    def crps(self, residual: Array, scale: Array | float) -> Array:
        """Continuous ranked probability score in the unit of the residual.

        It is the mean absolute error of a prediction that states its own spread; for scale → 0 it is |r|. Of
        Student's t after Jordan, Krüger and Lerch 2019, doi:10.18637/jss.v090.i12.
        """
        z, n = residual / scale, self.freedom
        density, slope = student.pdf(z, n), z * (2 * student.cdf(z, n) - 1)
        if np.isinf(n):
            return scale * (slope + 2 * density - 1 / np.sqrt(np.pi))
        constant = 2 * np.sqrt(n) / (n - 1) * np.exp(betaln(0.5, n - 0.5) - 2 * betaln(0.5, n / 2))
        return scale * (slope + 2 * density * (n + z**2) / (n - 1) - constant)


GAUSSIAN = Tails()


def normalised_calibration_error(residual: Array, sigma: Array) -> float:
    """ENCE: mean over bins of σ of ``|rms σ − rms r| / rms σ``.

    Levi, Gispan, Giladi and Fetaya 2022, doi:10.3390/s22155540. Bins hold equal counts; pixels of one σ stay
    in one bin, so that a constant σ has one. Chance leaves about ``1/√(π n)`` for n independent pixels a bin.

    Args:
        residual, sigma: (pixels,), one unit.
    """
    number = equal_counts(sigma, _BINS)[1]
    count = np.bincount(number)
    used = count > 0
    stated, there = (np.sqrt(np.bincount(number, part**2)[used] / count[used]) for part in (sigma, residual))
    return float(np.mean(np.abs(stated - there) / stated))


def equal_counts(values: Array, bins: int) -> tuple[Array, Array]:
    """Limits of bins of equal counts, fewer where values repeat, and the bin of each value."""
    limits = np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)))
    return limits, np.searchsorted(limits[1:-1], values, side="right")


def sparsification_error(residual: Array, sigma: Array) -> float:
    """AUSE: excess of the mean ``|r|`` over the best possible while the pixels of largest σ are removed.

    Area between the two curves over the removed share, 0 to 1, in units of the mean ``|r|`` of all pixels;
    0 where σ orders the pixels as ``|r|`` does. Ilg et al. 2018, arXiv:1802.07095. Pixels of one σ count with
    their mean, so that their order does not matter.

    Args:
        residual, sigma: (pixels,), one unit; not all residuals zero.
    """
    error = np.abs(residual)
    value, group = np.unique(sigma, return_inverse=True)
    of_group = np.bincount(group, error, minlength=len(value)) / np.bincount(group, minlength=len(value))
    kept = np.arange(1, error.size + 1)
    by_sigma, best = (np.cumsum(ordered) / kept for ordered in (of_group[np.sort(group)], np.sort(error)))
    return float(np.mean(by_sigma - best) / error.mean())
