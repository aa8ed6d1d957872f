"""The learning rate of a search over its iterations."""

from __future__ import annotations

from typing import Any

from torch.optim import Optimizer
from torch.optim.lr_scheduler import ReduceLROnPlateau, StepLR

from litho_design.optimisation.settings import PROGRESS, SearchSettings


class RateSchedule:
    """Lowers the rate of ``optimiser`` as ``rate_schedule`` says; its state goes into the checkpoint."""

    def __init__(self, optimiser: Optimizer, settings: SearchSettings):
        self._schedule: StepLR | ReduceLROnPlateau | None = None
        if settings.rate_schedule == "step":
            self._schedule = StepLR(optimiser, settings.rate_iterations, settings.rate_factor)
        elif settings.rate_schedule == "plateau":
            # Relative to the loss, PyTorch's own, a threshold is none where a loss is negative.
            self._schedule = ReduceLROnPlateau(
                optimiser,
                factor=settings.rate_factor,
                patience=settings.rate_iterations,
                threshold=PROGRESS,
                threshold_mode="abs",
            )

    def after_step(self, loss: float) -> None:
        """An iteration has been made, and its sample had this loss."""
        if isinstance(self._schedule, ReduceLROnPlateau):
            self._schedule.step(loss)
        elif self._schedule is not None:
            self._schedule.step()

    def state_dict(self) -> dict[str, Any]:
        """What a resumed search needs; empty for a constant rate."""
        return {} if self._schedule is None else self._schedule.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where ``state_dict`` was taken."""
        if self._schedule is not None:
            self._schedule.load_state_dict(state)
