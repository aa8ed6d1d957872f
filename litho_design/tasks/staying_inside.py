"""How far a layout is from the training layouts of its model, and what a layout closer to them scores."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from litho_design.optimisation.fabrication import outside
from litho_design.optimisation.parameters import DirectLevels
from litho_design.optimisation.search import search_layout
from litho_design.optimisation.settings import SearchSettings
from litho_design.printers.training import OutOfDistribution, out_of_distribution

# Brings a hologram from 0.67 to 0.2 of the level distance in twenty iterations.
_INSIDE_WEIGHT, _ITERATIONS = 0.5, 20


def cost_of_staying_inside(task: Any, level: Tensor) -> OutOfDistribution | None:
    """Distance of levels (size, size) from the training layouts; where large, the scores of closer ones.

    They are those of a short search from the layout with a penalty on what the training layouts have not.

    Args:
        task: the ``Task``, which calls this.
    """
    layout, card = task.settings.layout, task.printer.card
    gauge = out_of_distribution(level.cpu().numpy(), layout, card)
    if gauge is None or not gauge.flagged or task.settings.fabrication.inside_weight:
        return gauge
    parameters = DirectLevels(layout, task.cells).to(level.device)
    parameters.start_from(task.cells.average(level.float()))

    def inside(level: Tensor) -> tuple[Tensor, dict[str, float]]:
        loss, parts = task.objective(level)
        return loss + _INSIDE_WEIGHT * outside(level, layout.levels, card), parts

    search = SearchSettings(iterations=_ITERATIONS, hard_from=0.0, evaluate_every=5)
    closer = search_layout(parameters, inside, search, what="staying inside").best_levels
    assert closer is not None
    kept_level = task.cells(closer)
    kept = out_of_distribution(kept_level.cpu().numpy(), layout, card)
    assert kept is not None
    return gauge.model_copy(
        update={
            "inside": task.score(task.printed_um(kept_level)).model_dump(),
            "inside_distance": kept.level_distance,
            "inside_step_distance": kept.step_distance,
        }
    )
