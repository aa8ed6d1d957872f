"""Define ranges of fitted values, and the rule for when a value is on its bound.

A fit changes a raw number, and the model uses the corresponding value inside its range. Near a bound, the
value hardly changes with the raw number, so a fit that reached the bound could not leave it again. Fits
therefore keep raw numbers within ``FLAT_FROM``. A value whose raw number is at that limit counts as on its
bound.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from litho_data.foundation.errors import InputError

# At this raw number, the slope of a sigmoid is 7 % of its maximum, and the value is 2 % of the range away
# from the bound.
FLAT_FROM = 4.0
_ROUNDING = 1e-4


@dataclass(frozen=True)
class Range:
    """The range of one fitted value: lower + (upper - lower) · sigmoid(raw), or lower + softplus(raw).

    Attributes:
        name: name of the value, with its unit.
        lower, upper: bounds; with an infinite ``upper`` the softplus is used.
    """

    name: str
    lower: float = 0.0
    upper: float = math.inf

    def value(self, raw: Tensor) -> Tensor:
        """Return the value that the model uses for a raw number."""
        if math.isinf(self.upper):
            return self.lower + functional.softplus(raw)
        return self.lower + (self.upper - self.lower) * torch.sigmoid(raw)

    def raw(self, value: float) -> Tensor:
        """Return the raw number that corresponds to a value.

        Raises:
            InputError: a value outside the range, or on a bound.
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
        """Return the bound on which a raw number lies; None inside the range."""
        low, high = self.raw_ends
        if raw <= low + _ROUNDING:
            return self.lower
        return self.upper if raw >= high - _ROUNDING else None
