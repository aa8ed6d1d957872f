"""Score a stated spread with closed-form scores for a Gaussian or Student's t, and with two scores that
assume no distribution.

The CRPS of a Gaussian follows Gneiting and Raftery 2007, doi:10.1198/016214506000001437, equation 21 with the
opposite sign.
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
    """The shape of a residual over its scale: Student's t, or a Gaussian for ``freedom`` = ∞."""

    freedom: float = float("inf")

    def log_likelihood(self, residual: Array, scale: Array | float) -> Array:
        """Return the log density per pixel, up to a constant that depends on the common unit of residual and
        scale.
        """
        return student.logpdf(residual / scale, self.freedom) - np.log(scale)

    def weight(self, z2: Array) -> Array | float:
        """Return −2 d log density / d z², the weight of a squared residual, which is 1 for a Gaussian."""
        return 1.0 if np.isinf(self.freedom) else (self.freedom + 1) / (self.freedom + z2)

    @property
    def information(self) -> float:
        """Return the Fisher information of a pixel about the logarithm of the squared scale."""
        return 0.5 if np.isinf(self.freedom) else 0.5 * self.freedom / (self.freedom + 3)

    @property
    def sd(self) -> float:
        """Return the ratio of standard deviation to scale; this requires more than two degrees of freedom."""
        return float(student.std(self.freedom))

    def probability_below(self, z: Array | float) -> Array:
        """Return the probability below z (PIT). For residuals divided by their scale, this probability is
        uniformly distributed if scale and shape are right.
        """
        return student.cdf(z, self.freedom)

    def half_width(self, level: float) -> float:
        """Return the half width, in units of the scale, of the central interval with the probability
        ``level``.
        """
        return float(student.ppf(0.5 + level / 2, self.freedom))

    def covered(self, residual: Array, scale: Array | float, level: float) -> Array:
        """Return for each pixel whether it lies within the central interval. The share of pixels in this
        interval should be ``level``.
        """
        return np.abs(residual) <= self.half_width(level) * scale

    def crps(self, residual: Array, scale: Array | float) -> Array:
        """Return the continuous ranked probability score in the unit of the residual.

        The score generalises the absolute error to a prediction with a stated spread; for scale → 0, it is
        |r|. For Student's t, it follows Jordan, Krüger and Lerch 2019, doi:10.18637/jss.v090.i12.
        """
        z, n = residual / scale, self.freedom
        density, slope = student.pdf(z, n), z * (2 * student.cdf(z, n) - 1)
        if np.isinf(n):
            return scale * (slope + 2 * density - 1 / np.sqrt(np.pi))
        constant = 2 * np.sqrt(n) / (n - 1) * np.exp(betaln(0.5, n - 0.5) - 2 * betaln(0.5, n / 2))
        return scale * (slope + 2 * density * (n + z**2) / (n - 1) - constant)


GAUSSIAN = Tails()


def normalised_calibration_error(residual: Array, sigma: Array) -> float:
    """Return ENCE, the mean over bins of σ of ``|rms σ − rms r| / rms σ``.

    Levi, Gispan, Giladi and Fetaya 2022, doi:10.3390/s22155540. Bins contain equal counts. Pixels with the
    same σ are in the same bin, so a constant σ has only one bin. If each bin contains n independent pixels,
    the result is about ``1/√(π n)`` by chance, even for a perfect σ.

    Args:
        residual, sigma: (pixels,), both in the same unit.
    """
    number = equal_counts(sigma, _BINS)[1]
    count = np.bincount(number)
    used = count > 0
    stated, there = (np.sqrt(np.bincount(number, part**2)[used] / count[used]) for part in (sigma, residual))
    return float(np.mean(np.abs(stated - there) / stated))


def equal_counts(values: Array, bins: int) -> tuple[Array, Array]:
    """Return the limits of bins of equal counts (fewer bins if values repeat) and the bin of each value."""
    limits = np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)))
    return limits, np.searchsorted(limits[1:-1], values, side="right")


def sparsification_error(residual: Array, sigma: Array) -> float:
    """Return AUSE, which states how well σ ranks the pixels by error; 0 is perfect.

    Pixels are removed in two orders, largest σ first and largest ``|r|`` first. For each order, the mean
    ``|r|`` of the remaining pixels is a function of the removed share, 0 to 1. AUSE is the area between the
    graphs of the two functions, in units of the mean ``|r|`` of all pixels. Ilg et al. 2018,
    arXiv:1802.07095. Each pixel in a group with the same σ counts with the mean of the group, so that the
    order within the group does not matter.

    Args:
        residual, sigma: (pixels,), both in the same unit. At least one residual must not be zero.
    """
    error = np.abs(residual)
    value, group = np.unique(sigma, return_inverse=True)
    of_group = np.bincount(group, error, minlength=len(value)) / np.bincount(group, minlength=len(value))
    kept = np.arange(1, error.size + 1)
    by_sigma, best = (np.cumsum(ordered) / kept for ordered in (of_group[np.sort(group)], np.sort(error)))
    return float(np.mean(by_sigma - best) / error.mean())
