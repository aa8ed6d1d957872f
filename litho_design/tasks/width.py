"""The width of a design: its layout as every model of the printer at hand prints it, beside doing nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.results import Record

if TYPE_CHECKING:
    from litho_design.tasks.task import Task

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
    def stated_median_worst(self) -> tuple[float, float, float]:
        """The figure by the first model, the median of all, and the worst."""
        values = self.values()
        return float(values[0]), float(np.median(values)), float(values.max() if self.less else values.min())

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


@torch.no_grad()
def best_layout(task: Task, searched: Tensor) -> tuple[Tensor, Width | None]:
    """The candidate that the models at hand agree on most: that of the smallest largest loss.

    Args:
        searched: levels of the search on the pixels (size, size).

    Returns:
        Its levels, and the width of the design; None where there is one model and nothing to compare with.
    """
    candidates = {SEARCHED: searched, **task.untouched()}
    models = {printer.name: printer for printer in (*task.printers, *task.judges)}
    if len(models) == 1 and len(candidates) == 1:
        return searched, None
    figures: dict[str, dict[str, dict[str, float]]] = {}
    for name, level in candidates.items():
        seen = {model: task.bench(one(level[None, None].float())[0, 0]) for model, one in models.items()}
        figures[name] = {
            model: {"loss": float(task.loss_and_parts(one)[0]), **task.window_figures(one)}
            for model, one in seen.items()
        }
    returned = min(figures, key=lambda name: max(one["loss"] for one in figures[name].values()))
    known = next(iter(figures[SEARCHED].values()))
    figure = next((name for name in (*task.headline, *known) if name in known), "loss")
    return candidates[returned], Width(
        searched_with=len(task.printers),
        figures=figures,
        returned=returned,
        figure=figure,
        less=figure in (*task.errors, "loss"),
        level_heights_um={model: list(one.level_heights_um()) for model, one in models.items()},
    )
