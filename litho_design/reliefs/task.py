"""The relief as a task: the layout whose print comes closest to a wanted height map."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from litho_data.foundation.results import Record
from litho_design.images.targets import TargetRecord
from litho_design.optics import Optics, centred_grid
from litho_design.optimisation.parameters import DirectLevels, Parametrisation
from litho_design.optimisation.starts import start_search
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.reliefs.settings import ReliefSettings
from litho_design.tasks.task import Task, register_task

UNPRINTABLE_FILE = "unprintable_um.npy"
_FREE_ITERATIONS = 100
_AFFINE_FACTORS = (0.6, 0.7, 0.8, 0.9, 1.0, 1.1)


class ReliefScore(Record):
    """Height errors of a print without their mean: the zero of a print is that of its base."""

    rms_nm: float = Field(description="rms error of the print, offset free, nm")
    mae_nm: float = Field(description="mean absolute error, offset free, nm")
    p95_nm: float = Field(description="95th percentile of the absolute error, nm")
    offset_nm: float = Field(description="mean of print minus target, nm")


class _Bare(nn.Module):
    """What is seen of a relief is the relief."""

    def __init__(self, layout: LayoutSettings):
        super().__init__()
        self.grid = self.window = centred_grid((layout.size_px, layout.size_px), layout.pitch_um)

    def forward(self, height_um: Tensor) -> Tensor:
        return height_um


@register_task
class ReliefTask(Task):
    """A wanted height map (size, size), µm, as ``load_relief`` gives it with its record.

    ``off_um`` among the inputs is what a first print was off from its expectation, without its mean: the
    search expects it again. Figures are those of the print alone, as others will measure it.

    Raises:
        InputError: a start for light, or spreads that no propagator could take.
    """

    name = "relief"
    starts = ("inverse", "random")
    headline = ("rms_nm", "mae_nm", "p95_nm")
    score_type = ReliefScore
    settings_type = ReliefSettings
    settings: ReliefSettings

    def __init__(
        self,
        settings: ReliefSettings,
        printer: Printer,
        *,
        inputs: Mapping[str, np.ndarray] | None = None,
        ensemble: Sequence[Printer] = (),
        record: TargetRecord | None = None,
    ):
        super().__init__(settings, printer, inputs=inputs, ensemble=ensemble)
        self.target = torch.from_numpy(self.inputs["relief_um"]).to(printer.device)
        off_um = self.inputs.get("off_um", np.zeros_like(self.inputs["relief_um"]))
        # What the model has to print, so that the printer prints the target.
        self.asked = self.target - torch.from_numpy(off_um).to(printer.device)
        self.target_record = record
        self.notes += [f"relief: {record.adaptation}"] if record and record.adaptation else []
        heights = printer.level_heights_um()
        span_um, reach_um = float(np.ptp(self.inputs["relief_um"])), max(heights) - min(heights)
        if span_um > reach_um:
            self.notes.append(
                f"the relief is {span_um:.3g} µm high, the levels print {reach_um:.3g} µm: its highest and "
                f"lowest parts are cut off; take --height-um {reach_um:.2g} or less, or more levels"
            )

    def make_bench(self, optics: Optics) -> Any:
        """The print itself, whatever the light."""
        return _Bare(self.settings.layout).to(self.printer.device)

    def loss(self, seen: Tensor) -> Tensor:
        """Rms error without its mean, µm."""
        return (seen - self.asked).std(correction=0)

    def figures(self, seen: Tensor) -> dict[str, float]:
        """Errors, nm."""
        error = 1000 * (seen - self.target).double()
        free = (error - error.mean()).abs()
        return {
            "rms_nm": float(free.square().mean().sqrt()),
            "mae_nm": float(free.mean()),
            "p95_nm": float(np.quantile(free.cpu().numpy(), 0.95)),
            "offset_nm": float(error.mean()),
        }

    def window_figures(self, seen: Tensor) -> dict[str, float]:
        """Errors without the offset: where the zero is free, no print passes or fails by it."""
        return {name: value for name, value in self.figures(seen).items() if name != "offset_nm"}

    def start(self, parameters: Parametrisation, level_heights_um: list[float]) -> None:
        """The level that prints the wanted height where it is uniform, or random levels."""
        start_search(
            parameters, self.settings.search, lambda: self._levels_printing(level_heights_um, self.asked)
        )

    def baselines(self) -> dict[str, dict[str, float]]:
        """Errors of the nominal layout, of the best affine correction, and of levels of any height."""
        nominal = [
            level * self.settings.layout.level_height_um for level in range(self.settings.layout.levels)
        ]
        printed = self.printer.level_heights_um()
        gain = (printed[-1] - printed[0]) / (nominal[-1] - nominal[0])
        # A layout of uniform gain, from the one of wide fields to the one of the finest detail.
        affine = [
            self._score_of_levels(
                self._levels_printing([factor * gain * one for one in nominal], self.target)
            )
            for factor in _AFFINE_FACTORS
        ]
        return {
            "uncorrected": self._score_of_levels(self._levels_printing(nominal, self.target)),
            "best affine": min(affine, key=lambda one: one["rms_nm"]),
            "free levels": self.figures(self._free_print),
        }

    def thick_score(self, height_um: Tensor) -> None:
        """A height is a height, whatever the light."""
        return

    def arrays(self, height_um: Tensor) -> dict[str, np.ndarray]:
        """Also what is left of the target with levels of any height: no layout of this range prints it."""
        left = self.asked - self._free_print
        return super().arrays(height_um) | {UNPRINTABLE_FILE: (left - left.mean()).cpu().numpy()}

    @cached_property
    def _free_print(self) -> Tensor:
        """The print of levels that need not be whole, of the lowest loss, µm."""
        search = self.settings.search
        free = DirectLevels(self.settings.layout).to(self.printer.device)
        free.start_from(self._levels_printing(self.printer.level_heights_um(), self.asked))
        optimiser = torch.optim.Adam(free.parameters(), lr=search.learning_rate * free.rate_unit)
        best, lowest = None, math.inf
        for _ in range(_FREE_ITERATIONS):
            print_um = self.printer(free.sample(1.0, False, 0))[0, 0]
            loss = self.loss(print_um)
            if float(loss.detach()) < lowest:
                best, lowest = print_um.detach(), float(loss.detach())
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            free.project()
        assert best is not None
        return best

    def _levels_printing(self, level_heights_um: Sequence[float], relief_um: Tensor) -> Tensor:
        """Real levels (*cells) that have a relief's heights where level k is ``level_heights_um[k]`` high.

        Zero is free: the middle of the relief lies in the middle of the levels.
        """
        heights, target = np.asarray(level_heights_um), relief_um.cpu().numpy()
        middle = (heights[0] + heights[-1] - target.min() - target.max()) / 2
        levels = np.interp(target + middle, heights, np.arange(len(heights)))
        return self.cells.average(torch.from_numpy(levels).float().to(self.printer.device))

    @torch.no_grad()
    def _score_of_levels(self, levels: Tensor) -> dict[str, float]:
        return self.figures(self.printer(self.cells(levels.round())[None, None])[0, 0])

    def display(self, seen: np.ndarray) -> np.ndarray:
        """Heights over the range of the target."""
        target = self.inputs["relief_um"]
        return (seen - seen.min()) / np.ptp(target)
