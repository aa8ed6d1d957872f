"""The learning rate of a search over its iterations."""

from __future__ import annotations

from torch.optim import Optimizer
from torch.optim.lr_scheduler import ReduceLROnPlateau, StepLR

from litho_design.optimisation.settings import PROGRESS, SearchSettings


def rate_schedule(optimiser: Optimizer, settings: SearchSettings) -> StepLR | ReduceLROnPlateau:
    """What lowers the rate of ``optimiser`` as the settings say; its state goes into the checkpoint."""
    factor, iterations = settings.rate_factor, settings.rate_iterations
    if settings.rate_schedule == "plateau":
        # Relative to the loss, PyTorch's own, a threshold is none where a loss is negative.
        return ReduceLROnPlateau(
            optimiser, factor=factor, patience=iterations, threshold=PROGRESS, threshold_mode="abs"
        )
    return StepLR(optimiser, iterations, factor if settings.rate_schedule == "step" else 1.0)


def lower_rate(schedule: StepLR | ReduceLROnPlateau, loss: float) -> None:
    """An iteration has been made, and its sample had this loss."""
    if isinstance(schedule, ReduceLROnPlateau):
        schedule.step(loss)
    else:
        schedule.step()
