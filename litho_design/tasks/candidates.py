"""The layout that a design returns: the searched one, or an uncorrected one if the models prefer it."""

from __future__ import annotations

import torch
from torch import Tensor

from litho_design.tasks.task import Task
from litho_design.tasks.width import SEARCHED, Width


@torch.no_grad()
def best_layout(task: Task, searched: Tensor) -> tuple[Tensor, Width | None]:
    """The candidate whose largest loss over the available models is smallest.

    Args:
        searched: levels of the search on the pixels (size, size).

    Returns:
        Its levels, and the width of the design; None if there is only one model and nothing to compare.
    """
    candidates = {SEARCHED: searched, **task.untouched()}
    models = {printer.name: printer for printer in (*task.printers, *task.judges)}
    if len(models) == 1 and len(candidates) == 1:
        return searched, None
    figures: dict[str, dict[str, dict[str, float]]] = {}
    for name, level in candidates.items():
        seen = {model: task.bench(task.printed_um(level, one)) for model, one in models.items()}
        figures[name] = {
            model: {"loss": float(task.loss_by(models[model], one)[0]), **task.window_figures(one)}
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
        loss_unit=task.loss_unit,
        level_heights_um={model: list(one.level_heights_um()) for model, one in models.items()},
    )
