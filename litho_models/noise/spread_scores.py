"""Compute scores that state how good a predicted spread of residuals is. Two scores (ENCE and AUSE) do not
assume any distribution. The others have closed forms for a Gaussian and for Student's t distribution.

The continuous ranked probability score (CRPS) of a Gaussian is equation 21 of Gneiting and Raftery 2007,
doi:10.1198/016214506000001437, with the opposite sign.
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
    """The distribution of a residual divided by its scale: Student's t with ``freedom`` degrees of freedom,
    or a Gaussian if ``freedom`` is infinite.
    """

    freedom: float = float("inf")

    def log_likelihood(self, residual: Array, scale: Array | float) -> Array:
        """Return the logarithm of the probability density of each residual. The result depends on the unit of
        residual and scale: another unit adds a constant to it.
        """
        return student.logpdf(residual / scale, self.freedom) - np.log(scale)

    def weight(self, z2: Array) -> Array | float:
        """Let z be a residual divided by its scale, and ``z2`` its square. Return the weight of this residual
        in a fit, which is −2 times the derivative of the log density with respect to z². For a Gaussian, the
        weight is 1.
        """
        return 1.0 if np.isinf(self.freedom) else (self.freedom + 1) / (self.freedom + z2)

    @property
    def information(self) -> float:
        """Return the Fisher information that one pixel carries about the logarithm of the squared scale."""
        return 0.5 if np.isinf(self.freedom) else 0.5 * self.freedom / (self.freedom + 3)

    @property
    def sd(self) -> float:
        """Return the ratio of the standard deviation to the scale. The ratio is finite only for more than two
        degrees of freedom.
        """
        return float(student.std(self.freedom))

    def probability_below(self, z: Array | float) -> Array:
        """Return the probability of values below z. For z, pass the residual divided by its scale; the result
        is then the probability integral transform. If both the scale and the distribution are right, this
        transform is uniformly distributed over the pixels.
        """
        return student.cdf(z, self.freedom)

    def half_width(self, level: float) -> float:
        """Return half the width of the central interval that contains a residual with the probability
        ``level``. The unit is the scale of the distribution.
        """
        return float(student.ppf(0.5 + level / 2, self.freedom))

    def covered(self, residual: Array, scale: Array | float, level: float) -> Array:
        """Return, for each pixel, whether its residual lies within the central interval for the probability
        ``level``. If the spread is calibrated, this is true for the share ``level`` of the pixels.
        """
        return np.abs(residual) <= self.half_width(level) * scale

    def crps(self, residual: Array, scale: Array | float) -> Array:
        """Return the continuous ranked probability score in the unit of the residual.

        The score generalises the absolute error to predictions that state a spread. As the scale approaches
        0, the score approaches the absolute value of the residual. For Student's t, the formula comes from
        Jordan, Krüger and Lerch 2019, doi:10.18637/jss.v090.i12.
        """
        z, n = residual / scale, self.freedom
        density, slope = student.pdf(z, n), z * (2 * student.cdf(z, n) - 1)
        if np.isinf(n):
            return scale * (slope + 2 * density - 1 / np.sqrt(np.pi))
        constant = 2 * np.sqrt(n) / (n - 1) * np.exp(betaln(0.5, n - 0.5) - 2 * betaln(0.5, n / 2))
        return scale * (slope + 2 * density * (n + z**2) / (n - 1) - constant)


GAUSSIAN = Tails()


def normalised_calibration_error(residual: Array, sigma: Array) -> float:
    """Return the expected normalised calibration error (ENCE). The ENCE is the mean of ``|rms σ − rms r| /
    rms σ`` over bins of σ, where r is the residual.

    See Levi, Gispan, Giladi and Fetaya 2022, doi:10.3390/s22155540. The bins contain equal numbers of pixels.
    Pixels with the same σ are in the same bin, so for a constant σ there is only one bin. If each bin
    contains n independent pixels, the result is about ``1/√(π n)`` by chance, even for a perfect σ.

    Args:
        residual, sigma: residual and stated standard deviation of each pixel, in the same unit, each of shape
            (pixels,).
    """
    number = equal_counts(sigma, _BINS)[1]
    count = np.bincount(number)
    used = count > 0
    stated, there = (np.sqrt(np.bincount(number, part**2)[used] / count[used]) for part in (sigma, residual))
    return float(np.mean(np.abs(stated - there) / stated))


def equal_counts(values: Array, bins: int) -> tuple[Array, Array]:
    """Divide values into bins with equal numbers of values. Return the limits of the bins, and the bin number
    of each value. If values repeat, there may be fewer than ``bins`` bins.
    """
    limits = np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)))
    return limits, np.searchsorted(limits[1:-1], values, side="right")


def sparsification_error(residual: Array, sigma: Array) -> float:
    """Return the area under the sparsification error (AUSE). The area states how well σ ranks the pixels by
    their error; it is 0 for a perfect ranking.

    Pixels are removed in two orders: those with the largest σ first, and those with the largest absolute
    residual ``|r|`` first. For each order, the mean ``|r|`` of the remaining pixels is a function of the
    share that is removed, from 0 to 1. AUSE is the area between the graphs of these two functions, divided by
    the mean ``|r|`` of all pixels (Ilg et al. 2018, arXiv:1802.07095). For pixels with the same σ, ``|r|`` is
    replaced by its mean over these pixels, so that their order does not matter.

    Args:
        residual, sigma: residual and stated standard deviation of each pixel, in the same unit, each of shape
            (pixels,). At least one residual must differ from zero.
    """
    error = np.abs(residual)
    value, group = np.unique(sigma, return_inverse=True)
    of_group = np.bincount(group, error, minlength=len(value)) / np.bincount(group, minlength=len(value))
    kept = np.arange(1, error.size + 1)
    by_sigma, best = (np.cumsum(ordered) / kept for ordered in (of_group[np.sort(group)], np.sort(error)))
    return float(np.mean(by_sigma - best) / error.mean())
