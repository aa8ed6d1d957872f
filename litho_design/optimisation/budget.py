"""Estimate the time and memory of a design before it starts."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable

import torch
from torch import nn

from litho_data.foundation.results import Record
from litho_design.optimisation.parameters import Parametrisation
from litho_design.optimisation.search import Objective
from litho_design.optimisation.settings import SearchSettings

_KIB_PER_GIB = 1 << 20


class Budget(Record):
    """Time and memory of one iteration of the search, measured on a trial iteration that leaves the
    parameters unchanged.
    """

    seconds_per_iteration: float
    seconds_per_evaluation: float
    peak_memory_gib: float

    def sentence(self, search: SearchSettings, done: int = 0, seconds_after: float = 0.0) -> str:
        """Return one line that estimates the memory and the remaining time of a run, after the first ``done``
        iterations. The time includes the other iterations, the scores and the report.
        """
        left = search.iterations - done
        searched = (left + search.polish_rounds) * self.seconds_per_iteration
        minutes = (searched + left / search.evaluate_every * self.seconds_per_evaluation + seconds_after) / 60
        what = f"{left} more iterations" if done else f"{search.iterations} iterations"
        return (
            f"estimate: {what} of {self.seconds_per_iteration:.2f} s each, about {minutes:.1f} min "
            f"including scores and report; peak memory {self.peak_memory_gib:.2f} GiB"
        )


def measure_budget(
    parameters: Parametrisation,
    objective: Objective,
    search: SearchSettings,
    clock: Callable[[], float] = time.perf_counter,
) -> Budget:
    """Time one iteration with gradients and one without gradients. The parameters stay unchanged."""
    assert isinstance(parameters, nn.Module)
    device = next(parameters.parameters()).device
    started = clock()
    loss, _ = objective(parameters.sample(search.temperature(0), seed=0))
    loss.backward()
    _wait(device)
    middle = clock()
    with torch.no_grad():
        objective(parameters.sample(search.temperature(0), seed=0))
    _wait(device)
    for parameter in parameters.parameters():
        parameter.grad = None
    return Budget(
        seconds_per_iteration=middle - started,
        seconds_per_evaluation=clock() - middle,
        peak_memory_gib=peak_memory_gib(device),
    )


def peak_memory_gib(device: torch.device | None = None) -> float:
    """Return the peak memory used so far on a CUDA device or, for any other device, by this process."""
    if device is not None and device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**30
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _KIB_PER_GIB


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
