"""The width of a design: figures of its layout and of uncorrected layouts according to all models."""

from __future__ import annotations

import numpy as np

from litho_data.foundation.results import Record

SEARCHED = "searched"
# 95 % of normal errors lie within twice the standard deviation.
_SURE = 2.0


class Width(Record):
    """Figures of a design by model: first the models of the search, then the judges, which the search did not
    use.

    Attributes:
        searched_with: how many of the models the search used.
        figures: figures by candidate and model, including ``loss``; candidates are the layout found by the
            search and the uncorrected ones.
        returned: the candidate with the smallest loss over all models (``Task.over_models``).
        figure: the first figure of the task; ``less``: whether it is better when lower.
        loss_unit: factor that converts the loss to the unit of the figure, if the loss is an error that
            includes the model's own error; otherwise None.
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
        """Return the figure of a candidate by every model; the default is the returned candidate."""
        by_model = self.figures[candidate or self.returned].values()
        return np.array([figures[self.figure] for figures in by_model])

    @property
    def between(self) -> tuple[float, float]:
        """Return the expected range of a print's figure: the range over models, widened by twice their own
        errors.
        """
        values = self.values()
        if self.loss_unit is None:
            return float(values.min()), float(values.max())
        losses = np.array([one["loss"] for one in self.figures[self.returned].values()])
        own_squared = ((self.loss_unit * losses) ** 2 - values**2).clip(min=0)
        low, high = (np.sqrt((values**2 + sign * _SURE**2 * own_squared).clip(min=0)) for sign in (-1, 1))
        return float(low.min()), float(high.max())

    @property
    def gain(self) -> float | None:
        """Return the gain of the figure over the best uncorrected layout, as the median over models."""
        sign = -1 if self.less else 1
        idle = [sign * self.values(name) for name in self.figures if name != SEARCHED]
        return float(np.median(sign * self.values() - np.max(idle, axis=0))) if idle else None

    @property
    def disagreement(self) -> float:
        """Return the range of the figure over the models."""
        return float(np.ptp(self.values()))

    @property
    def open_level(self) -> tuple[int, float, float]:
        """Return the level on whose height the models disagree most, with its lowest and highest height,
        µm.
        """
        heights = np.array(list(self.level_heights_um.values()))
        heights = heights - heights[:, :1]
        level = int(np.ptp(heights, axis=0).argmax())
        return level, float(heights[:, level].min()), float(heights[:, level].max())
