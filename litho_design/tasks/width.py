"""The width of a design: its layout as every model of the printer at hand prints it, beside doing nothing."""

from __future__ import annotations

import numpy as np

from litho_data.foundation.results import Record

SEARCHED = "searched"
# Of normal errors 95 % lie within twice their standard deviation.
_SURE = 2.0


class Width(Record):
    """One entry per model: those of the search first, then the judges, which took no part in it.

    Attributes:
        searched_with: how many of the models the search used.
        figures: by candidate and model, ``loss`` among them; candidates are the searched layout and those of
            doing nothing.
        returned: the candidate whose largest loss over the models is the smallest.
        figure: the first one of the task; ``less``: whether it is better when lower.
        loss_unit: what turns a loss into the figure with the error of the model itself; None where it is no
            such error.
        level_heights_um: printed height of a wide field of each level, by model.
    """

    searched_with: int
    figures: dict[str, dict[str, dict[str, float]]]
    returned: str
    figure: str
    less: bool
    loss_unit: float | None = None
    level_heights_um: dict[str, list[float]]

    def values(self, candidate: str | None = None) -> np.ndarray:
        """The figure of a candidate, by default of the returned one, by every model."""
        by_model = self.figures[candidate or self.returned].values()
        return np.array([figures[self.figure] for figures in by_model])

    @property
    def between(self) -> tuple[float, float]:
        """Where the figure of a print is to be expected: among models, and off by twice their own error."""
        values = self.values()
        if self.loss_unit is None:
            return float(values.min()), float(values.max())
        losses = np.array([one["loss"] for one in self.figures[self.returned].values()])
        own_squared = ((self.loss_unit * losses) ** 2 - values**2).clip(min=0)
        low, high = (np.sqrt((values**2 + sign * _SURE**2 * own_squared).clip(min=0)) for sign in (-1, 1))
        return float(low.min()), float(high.max())

    @property
    def gain(self) -> float | None:
        """How much better the figure is than the best of doing nothing, the median over models."""
        sign = -1 if self.less else 1
        idle = [sign * self.values(name) for name in self.figures if name != SEARCHED]
        return float(np.median(sign * self.values() - np.max(idle, axis=0))) if idle else None

    @property
    def disagreement(self) -> float:
        """Range of the figure over the models."""
        return float(np.ptp(self.values()))

    @property
    def open_level(self) -> tuple[int, float, float]:
        """The level about whose height the models disagree most, and the lowest and highest of them, µm."""
        heights = np.array(list(self.level_heights_um.values()))
        heights = heights - heights[:, :1]
        level = int(np.ptp(heights, axis=0).argmax())
        return level, float(heights[:, level].min()), float(heights[:, level].max())
