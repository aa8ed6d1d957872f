"""Polish a printable layout: change the levels of cells by one, and keep the changes only if they lower the
loss.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from litho_data.commands.progress import progress
from litho_design.optimisation.parameters import CellMap
from litho_design.optimisation.search import Objective

# Share of the cells that the first round changes.
_FIRST_SHARE = 0.02


def polish_levels(
    levels: Tensor, cells: CellMap, objective: Objective, *, level_count: int, rounds: int
) -> tuple[Tensor, list[float]]:
    """Improve an integer layout by changing the levels of cells by one. The loss never rises. The gradient of
    the loss predicts how much each change would lower the loss. Each round changes a certain share of the
    cells together, namely the cells for which the predicted decrease of the loss is largest. If the loss of
    the changed layout is not lower, the changes are discarded and the share is halved.

    Args:
        levels: level of each cell, an int64 tensor with one value per cell.
        level_count: number of printable levels.
        rounds: largest number of rounds. Each round evaluates the loss and its gradient once.

    Returns:
        The improved levels in the same form, and a list of the losses at the start and after each accepted
        round.
    """
    best, share = levels.clone(), _FIRST_SHARE
    gain, move, loss = _rank_moves(best, cells, objective, level_count)
    losses = [loss]
    for _ in progress(range(rounds), "polishing", estimate_of=0):
        count = min(math.ceil(share * best.numel()), int((gain > 0).sum()))
        if count == 0:
            break
        chosen = gain.flatten().topk(count).indices
        trial = best.clone()
        trial.view(-1)[chosen] += move.flatten()[chosen]
        trial_gain, trial_move, trial_loss = _rank_moves(trial, cells, objective, level_count)
        if trial_loss < losses[-1]:
            best, gain, move = trial, trial_gain, trial_move
            losses.append(trial_loss)
        else:
            share /= 2
    return best, losses


def _rank_moves(
    levels: Tensor, cells: CellMap, objective: Objective, level_count: int
) -> tuple[Tensor, Tensor, float]:
    """For each cell, estimate to first order how much the loss falls if only the level of this cell changes
    by one, in the better direction.

    Returns:
        The decrease of the loss for each cell, the change of its level (-1 or +1), and the loss of the
        unchanged layout.
    """
    values = levels.float().requires_grad_()
    loss, _ = objective(cells(values)[None, None])
    (slope,) = torch.autograd.grad(loss, values)
    move = -slope.sign().long()
    allowed = (levels + move >= 0) & (levels + move < level_count)
    return torch.where(allowed, slope.abs(), 0.0), move, float(loss.detach())
