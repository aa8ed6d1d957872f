"""The search loop of every task. It optimises free parameters, keeps the best or the last printable layout,
and resumes from checkpoints.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor
from torch.optim.lr_scheduler import ReduceLROnPlateau, StepLR

from litho_data.commands.progress import progress
from litho_data.foundation.errors import InputError
from litho_design.optimisation.checkpoint import (
    SearchState,
    checkpoint_path,
    load_checkpoint,
    save_checkpoint,
)
from litho_design.optimisation.parameters import Parametrisation
from litho_design.optimisation.settings import PROGRESS, SearchSettings

Objective = Callable[[Tensor], tuple[Tensor, dict[str, float]]]


def search_layout(
    parameters: Parametrisation,
    objective: Objective,
    settings: SearchSettings,
    *,
    folder: Path | None = None,
    fingerprint: str = "",
    what: str = "designing",
    part: str = "",
) -> SearchState:
    """Minimise ``objective`` over layouts. The layout that is kept is always printable: each cell has its
    most probable level (argmax). The setting ``keep`` says whether the best or the last evaluated layout is
    kept.

    Args:
        parameters: free parameters with their starting values; they are changed in place.
        objective: function of levels on the pixels, shape (1, 1, size, size), that returns a scalar loss and
            a dict of its named parts.
        folder: folder in which the checkpoint is written, or None to run without a checkpoint.
        fingerprint: text that identifies the task. A search does not resume from a checkpoint of another
            task.
        what: word that the progress display shows for the work.
        part: text that names this process if several processes share the search. The name of the checkpoint
            contains this text.

    Returns:
        The final state. It contains the levels that were kept (``best_levels``, one per cell) and the
        history. The history has one record per evaluated iteration, with the loss of the sampled layout and
        the loss of the printable (argmax) layout.

    Raises:
        InputError: the checkpoint in ``folder`` belongs to another task, or the loss is not finite.
    """
    optimiser_class = torch.optim.Adam if settings.optimiser == "adam" else torch.optim.AdamW
    optimiser = optimiser_class(parameters.parameters(), lr=settings.learning_rate * parameters.rate_unit)
    rate = rate_schedule(optimiser, settings)
    stateful = {"parameters": parameters, "optimiser": optimiser, "rate": rate}
    state = SearchState()
    checkpoint = None if folder is None else checkpoint_path(folder, part)
    if checkpoint is not None and checkpoint.exists():
        state = load_checkpoint(checkpoint, fingerprint, stateful, next(parameters.parameters()).device)
    started = time.monotonic() - state.earlier_seconds
    remaining = range(state.iteration, settings.iterations)
    for iteration in progress(remaining, what, total=len(remaining), estimate_of=0):
        step_loss = _step(parameters, objective, optimiser, settings, iteration)
        lower_rate(rate, step_loss)
        state.iteration = iteration + 1
        if iteration % settings.evaluate_every == 0 or state.iteration == settings.iterations:
            _evaluate(parameters, objective, settings, state, step_loss)
        if checkpoint is not None and state.iteration % settings.checkpoint_every == 0:
            save_checkpoint(checkpoint, fingerprint, state, stateful, time.monotonic() - started)
    return state


def _step(
    parameters: Parametrisation,
    objective: Objective,
    optimiser: torch.optim.Optimizer,
    settings: SearchSettings,
    iteration: int,
) -> float:
    # The noise depends only on seed and iteration, so that a resumed run draws the same numbers.
    seed = settings.seed * 1_000_003 + iteration
    optimiser.zero_grad(set_to_none=True)
    level = parameters.sample(settings.temperature(iteration), seed)
    loss, _ = objective(level)
    if not torch.isfinite(loss):
        raise InputError(
            f"loss at iteration {iteration}",
            got=float(loss),
            wanted="a finite number",
            hint="lower the learning rate",
        )
    loss.backward()
    optimiser.step()
    parameters.project()
    return float(loss.detach())


@torch.no_grad()
def _evaluate(
    parameters: Parametrisation,
    objective: Objective,
    settings: SearchSettings,
    state: SearchState,
    step_loss: float,
) -> None:
    levels = parameters.best_levels()
    loss, parts = objective(parameters.cells(levels)[None, None].float())
    value = float(loss)
    state.history.append(
        {"iteration": state.iteration, "sample_loss": step_loss, "argmax_loss": value, **parts}
    )
    if settings.keep == "last" or value < state.best_loss:
        state.best_loss, state.best_levels = value, levels.clone()


def rate_schedule(optimiser: torch.optim.Optimizer, settings: SearchSettings) -> StepLR | ReduceLROnPlateau:
    """Make the scheduler that lowers the learning rate of ``optimiser`` as the settings say. The checkpoint
    stores the state of the scheduler.
    """
    factor, iterations = settings.rate_factor, settings.rate_iterations
    if settings.rate_schedule == "plateau":
        # By default, the threshold of PyTorch is relative to the loss, which does not work if the loss is
        # negative.
        return ReduceLROnPlateau(
            optimiser, factor=factor, patience=iterations, threshold=PROGRESS, threshold_mode="abs"
        )
    return StepLR(optimiser, iterations, factor if settings.rate_schedule == "step" else 1.0)


def lower_rate(schedule: StepLR | ReduceLROnPlateau, loss: float) -> None:
    """Tell the scheduler that an iteration has finished; ``loss`` is the loss of the sampled layout."""
    if isinstance(schedule, ReduceLROnPlateau):
        schedule.step(loss)
    else:
        schedule.step()
