"""Ranges of fitted values, and the rule that decides whether a value counts as lying on a bound of its range.

A fit does not change a value directly. It changes a raw number, which a formula converts to a value inside
the range. Very close to a bound, the value hardly changes with the raw number, so a fit could not leave the
bound again. Fits therefore keep the raw number above -``FLAT_FROM`` and, if the range has an upper bound,
below ``FLAT_FROM``. A value whose raw number has reached such a limit counts as lying on the bound.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from litho_data.foundation.errors import InputError

# Largest magnitude of a raw number. At this raw number, the slope of the sigmoid is 7 % of its maximum, and
# the distance of the value from the bound is 2 % of the range.
FLAT_FROM = 4.0
_ROUNDING = 1e-4


@dataclass(frozen=True)
class Range:
    """The range of one fitted value: value = lower + (upper - lower) · sigmoid(raw). If there is no upper
    bound, value = lower + softplus(raw).

    Attributes:
        name: name of the value, with its unit.
        lower, upper: bounds of the value; an infinite ``upper`` means that there is no upper bound.
    """

    name: str
    lower: float = 0.0
    upper: float = math.inf

    def value(self, raw: Tensor) -> Tensor:
        """Return the value that corresponds to a raw number."""
        if math.isinf(self.upper):
            return self.lower + functional.softplus(raw)
        return self.lower + (self.upper - self.lower) * torch.sigmoid(raw)

    def raw(self, value: float) -> Tensor:
        """Return the raw number that corresponds to a value.

        Raises:
            InputError: the value is outside the range or on a bound.
        """
        if not self.lower < value < self.upper:
            raise InputError(
                self.name, got=value, wanted=f"a value between {self.lower:g} and {self.upper:g}"
            )
        above = value - self.lower
        if math.isinf(self.upper):
            return torch.tensor(math.log(math.expm1(above)))
        return torch.tensor(math.log(above / (self.upper - value)))

    @property
    def raw_ends(self) -> tuple[float, float]:
        """Return the smallest and largest raw number that a fit may reach."""
        return -FLAT_FROM, math.inf if math.isinf(self.upper) else FLAT_FROM

    def bound_at(self, raw: float) -> float | None:
        """Return the bound on which a value with this raw number lies. Return None if the value lies on
        neither bound.
        """
        low, high = self.raw_ends
        if raw <= low + _ROUNDING:
            return self.lower
        return self.upper if raw >= high - _ROUNDING else None
