"""Define the allowed ranges of physical quantities. Annotated types check the fields of records, and
``Range`` checks all other values.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from litho_data.foundation.errors import InputError


@dataclass(frozen=True)
class Range:
    """The lowest and highest allowed values of a quantity; both are finite."""

    low: float
    high: float
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()

    def holds(self, values: object) -> bool:
        """Return whether the value, or every value of an array, is a number within the range."""
        if isinstance(values, bool):
            return False
        try:
            numbers = np.asarray(values, dtype=float)
        except (TypeError, ValueError, OverflowError):
            return False
        return bool(np.all((numbers >= self.low) & (numbers <= self.high)))

    def require(self, what: str, values: object) -> None:
        """Refuse values that are not numbers or are out of range.

        Raises:
            InputError: a value is not a number or is out of range. The message shows the first such value.
        """
        wrong = [one for one in np.ravel(np.asarray(values, dtype=object)) if not self.holds(one)]
        if wrong:
            raise InputError(what, got=repr(wrong[0])[:40], wanted=f"a number from {self}")


# A pitch lies between a tenth of a nanometre and one centimetre.
PITCH_UM = Range(1e-4, 1e4, "µm")
LEVEL_HEIGHT_UM = Range(1e-5, 1e3, "µm")
HEIGHT_UM = Range(-1e5, 1e5, "µm")
LENGTH_UM = Range(1e-6, 1e7, "µm")
PLACE_UM = Range(-1e7, 1e7, "µm")
DOSE = Range(1e-3, 1e3)
ORDER = Range(-1e9, 1e9)
LEVELS = Range(2, 65536)

PitchUm = Annotated[float, Field(ge=PITCH_UM.low, le=PITCH_UM.high)]
LevelHeightUm = Annotated[float, Field(ge=LEVEL_HEIGHT_UM.low, le=LEVEL_HEIGHT_UM.high)]
Levels = Annotated[int, Field(ge=int(LEVELS.low), le=int(LEVELS.high))]
