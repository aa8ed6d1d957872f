"""The width of a design: its layout as every model of the printer at hand prints it, beside doing nothing."""

from __future__ import annotations

import numpy as np

from litho_data.foundation.results import Record

SEARCHED = "searched"


class Width(Record):
    """One entry per model: those of the search first, then the judges, which took no part in it.

    Attributes:
        searched_with: how many of the models the search used.
        figures: by candidate and model, ``loss`` among them; candidates are the searched layout and those of
            doing nothing.
        returned: the candidate whose largest loss over the models is the smallest.
        figure: the first one of the task; ``less``: whether it is better when lower.
        level_heights_um: printed height of a wide field of each level, by model.
    """

    searched_with: int
    figures: dict[str, dict[str, dict[str, float]]]
    returned: str
    figure: str
    less: bool
    level_heights_um: dict[str, list[float]]

    def values(self, candidate: str | None = None) -> np.ndarray:
        """The figure of a candidate, by default of the returned one, by every model."""
        by_model = self.figures[candidate or self.returned].values()
        return np.array([figures[self.figure] for figures in by_model])

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
