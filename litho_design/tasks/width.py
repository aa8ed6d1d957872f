"""The width of a design, i.e. how much different models disagree about the score of its layout. Uncorrected
layouts (see ``Task.untouched``) are scored for comparison.
"""

from __future__ import annotations

import numpy as np

from litho_data.foundation.results import Record

SEARCHED = "searched"
# 95 % of normally distributed errors lie within this multiple of the standard deviation.
_SURE = 2.0


class Width(Record):
    """Scores of a design according to each model. The models that the search used come first, followed by the
    judges, which the search did not use.

    Attributes:
        searched_with: number of models that the search used.
        figures: scores of each candidate according to each model, keyed by name. One of the scores is
            ``loss``. The candidates are the layout found by the search and the uncorrected layouts.
        returned: name of the candidate with the smallest loss over all models (``Task.over_models``).
        figure: name of the main score, which is the first headline score of the task.
        less: True if the main score is better when lower.
        loss_unit: factor that converts the loss to the unit of the main score. It is given only if the loss
            contains the expected error of the model's prediction; otherwise, it is None.
        level_heights_um: for each model, the printed height of a wide uniform field of each level.
    """

    searched_with: int
    figures: dict[str, dict[str, dict[str, float]]]
    returned: str
    figure: str
    less: bool
    loss_unit: float | None = None
    level_heights_um: dict[str, list[float]]

    def values(self, candidate: str | None = None) -> np.ndarray:
        """Return the main score of a candidate according to every model. By default, the candidate is
        ``returned``.
        """
        by_model = self.figures[candidate or self.returned].values()
        return np.array([figures[self.figure] for figures in by_model])

    @property
    def between(self) -> tuple[float, float]:
        """Return the range in which the main score of a real print is expected. This range covers the values
        v that the models predict. If ``loss_unit`` is set, the loss of each model also contains the expected
        error e of the model. The range then covers, for each model, the interval from sqrt(v^2 - (2e)^2) to
        sqrt(v^2 + (2e)^2).
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
        """Return the gain of the design, i.e. how much better its main score is than the main score of the
        best uncorrected layout. The gain is computed for each model, and the median is returned. Return None
        if no uncorrected layout was compared.
        """
        sign = -1 if self.less else 1
        idle = [sign * self.values(name) for name in self.figures if name != SEARCHED]
        return float(np.median(sign * self.values() - np.max(idle, axis=0))) if idle else None

    @property
    def disagreement(self) -> float:
        """Return the difference between the largest and the smallest value of the main score over the
        models.
        """
        return float(np.ptp(self.values()))

    @property
    def open_level(self) -> tuple[int, float, float]:
        """Return the level whose printed height above level 0 differs most between the models. Also return
        the lowest and the highest prediction of this height, µm.
        """
        heights = np.array(list(self.level_heights_um.values()))
        heights = heights - heights[:, :1]
        level = int(np.ptp(heights, axis=0).argmax())
        return level, float(heights[:, level].min()), float(heights[:, level].max())
