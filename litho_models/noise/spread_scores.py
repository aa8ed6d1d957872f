"""The shape of a residual over its scale: a Gaussian or Student's t."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from litho_data.foundation.kinds import Array

COVERAGE_LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95)


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


GAUSSIAN = Tails()
