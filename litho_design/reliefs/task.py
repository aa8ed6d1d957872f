"""The task of a relief: find the layout whose print comes closest to a target height map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from pydantic import Field
from scipy.optimize import minimize
from torch import Tensor, nn

from litho_data.foundation.results import Record
from litho_design.images.targets import TargetRecord
from litho_design.optics import Optics, centred_grid
from litho_design.optimisation.descent import descended
from litho_design.optimisation.parameters import DirectLevels
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.printers.training import own_error_um
from litho_design.reliefs.settings import ReliefSettings
from litho_design.reliefs.targets import print_off_um
from litho_design.tasks.task import Task, register_task

UNPRINTABLE_FILE = "unprintable_um.npy"
_FREE_ITERATIONS = 100
# Affine layouts (level = gain * height + zero) from which the search for the best one starts. The first tuple
# contains gains, relative to the inverse of the printer's gain. The second contains positions between the
# lowest level (0) and the highest level (1).
_AFFINE_GAINS, _AFFINE_ZEROS = (0.5, 0.65, 0.8, 0.95, 1.1, 1.3), (0.0, 0.5, 1.0)
_AFFINE_STEPS = 20


class ReliefScore(Record):
    """Errors of the heights of a print. The mean error is subtracted, because the zero of the heights depends
    on the base under the print.
    """

    rms_nm: float = Field(description="rms error of the print without its mean error, nm")
    mae_nm: float = Field(description="mean absolute error without the mean error, nm")
    p95_nm: float = Field(description="95th percentile of the absolute error, nm")
    offset_nm: float = Field(description="mean of print minus target, nm")


class _Bare(nn.Module):
    """The bench of a relief. It returns the heights of a print unchanged, because no light is computed for a
    relief.
    """

    def __init__(self, layout: LayoutSettings):
        super().__init__()
        self.grid = self.window = centred_grid((layout.size_px, layout.size_px), layout.pitch_um)

    def forward(self, height_um: Tensor) -> Tensor:
        return height_um


@register_task
class ReliefTask(Task):
    """The task of printing a target height map in µm, shape (size, size). ``load_relief`` returns such a map
    and its record.

    The inputs ``first_level`` and ``first_print_um``, both of shape (size, size), are the layout of a first
    print and its measured heights. The deviation of the first print from its prediction is computed for each
    printer model. The next print is expected to have the same deviation, so ``printed`` adds it to the
    prediction of the model. The search and the scores then compare this expected real print with the target.

    Raises:
        InputError: the start in the settings works only for holograms or lenses, or the propagator is not
            valid for some draw of the process window.
    """

    name = "relief"
    starts = ("inverse", "random")
    headline = errors = ("rms_nm", "mae_nm", "p95_nm")
    loss_unit = 1e3
    score_type = ReliefScore
    settings_type = ReliefSettings
    settings: ReliefSettings

    def __init__(
        self,
        settings: ReliefSettings,
        printer: Printer,
        *,
        inputs: Mapping[str, np.ndarray],
        ensemble: Sequence[Printer] = (),
        record: TargetRecord | None = None,
    ):
        super().__init__(settings, printer, inputs=inputs, ensemble=ensemble, record=record)
        self.target = torch.from_numpy(self.inputs["relief_um"]).to(printer.device)
        self._off: dict[Printer, Tensor] = {}
        for one in self.printers:
            # The deviation is computed here, before the search, because the models may run at a lower
            # precision in the search.
            self._off_um(one)
        if "first_level" in self.inputs:
            self.notes.append(
                "the print according to each model includes the deviation of the measured first print from "
                "the prediction of this model"
            )
        self.notes += [f"relief: {record.adaptation}"] if record and record.adaptation else []
        heights = printer.level_heights_um()
        span_um, reach_um = float(np.ptp(self.inputs["relief_um"])), max(heights) - min(heights)
        if span_um > reach_um:
            self.notes.append(
                f"the relief is {span_um:.3g} µm high, but the levels print only {reach_um:.3g} µm, so its "
                f"highest and lowest parts are cut off; use --height-um {reach_um:.2g} or less, or more "
                "levels"
            )

    def make_bench(self, optics: Optics) -> Any:
        """Return a bench that returns the heights of a print unchanged."""
        return _Bare(self.settings.layout).to(self.printer.device)

    def printed(self, level: Tensor, printer: Printer) -> Tensor:
        """Return the expected height of a real print, µm, shape (size, size). It is the prediction of the
        printer. If there is a first print, its deviation from the prediction of this printer is added.
        """
        return super().printed(level, printer) + self._off_um(printer)

    def _off_um(self, printer: Printer) -> Tensor:
        """Return the deviation of the first print from the prediction of a printer, µm, shape (size, size).
        It is 0 if there is no first print.
        """
        if "first_level" not in self.inputs:
            return torch.zeros_like(self.target)
        if printer not in self._off:
            level = torch.from_numpy(self.inputs["first_level"]).to(self.target)[None, None]
            with torch.no_grad():
                predicted_um = super().printed(level, printer).cpu().numpy()
            blur_px = self.settings.off_blur_um / self.settings.layout.pitch_um
            off_um = print_off_um(self.inputs["first_print_um"], predicted_um, blur_px)
            self._off[printer] = torch.from_numpy(off_um).to(self.target)
        return self._off[printer]

    def loss(self, seen: Tensor) -> Tensor:
        """Return the rms error of a print, µm, after the mean error is subtracted."""
        return (seen - self.target).std(correction=0)

    def loss_by(self, printer: Printer, seen: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Return the expected rms error of a real print, µm. Two errors are added in quadrature: the error of
        the predicted print, and the expected error of the prediction.
        """
        rms_um = self.loss(seen)
        own_um = own_error_um(printer.card, float(self.target.std()))
        return (rms_um.square() + own_um**2).sqrt(), {"rms": float(rms_um.detach())}

    def over_models(self, losses: Tensor) -> Tensor:
        """Return the expected rms error, µm, under the assumption that all models are equally likely to be
        right.
        """
        return losses.square().mean().sqrt()

    def figures(self, seen: Tensor) -> dict[str, float]:
        """Return the errors, in nm, of a print relative to the target."""
        error = 1000 * (seen - self.target).double()
        free = (error - error.mean()).abs()
        return {
            "rms_nm": float(free.square().mean().sqrt()),
            "mae_nm": float(free.mean()),
            "p95_nm": float(np.quantile(free.cpu().numpy(), 0.95)),
            "offset_nm": float(error.mean()),
        }

    def window_figures(self, seen: Tensor) -> dict[str, float]:
        """Return the errors of a print, leaving out ``offset_nm``. The zero of the heights is arbitrary, so
        the offset must not decide whether the print passes.
        """
        return {name: value for name, value in self.figures(seen).items() if name != "offset_nm"}

    def start_levels(self, level_phase: Tensor) -> Tensor:
        """Return the level of each cell from which the search starts. Of four candidates, the one with the
        lowest expected loss is used. One candidate is the best affine layout. In the other three, the level
        of each cell is chosen so that a wide uniform field of this level would have the target height. These
        three place the relief at the bottom, in the middle and at the top of the printable heights.
        """
        heights = self.printer.level_heights_um()
        starts = [self._levels_printing(heights, self._asked, zero) for zero in _AFFINE_ZEROS]
        return min((*starts, self.cells.average(self._best_affine)), key=self._expected)

    def untouched(self) -> dict[str, Tensor]:
        """Return two uncorrected layouts: ``uncorrected``, whose nominal heights are the target heights, and
        ``best affine``, whose levels are ``gain * height + zero``.
        """
        return {"uncorrected": self._nominal.long(), "best affine": self._best_affine.long()}

    def baselines(self) -> dict[str, dict[str, float]]:
        """Return the errors of the two uncorrected layouts, and the errors of the best unrounded levels."""
        with torch.no_grad():
            found = {name: self.figures(self.printed_um(one)) for name, one in self.untouched().items()}
        return found | {"free levels": self.figures(self._free_print)}

    @property
    def _asked(self) -> Tensor:
        """Return the height map, µm, that the model must predict if the expected print is to equal the
        target.
        """
        return self.target - self._off_um(self.printer)

    @property
    def _nominal(self) -> Tensor:
        """Return the levels, shape (size, size), whose nominal heights are the target heights. A relief with
        heights below 0 is lifted, so that its lowest point is at 0.
        """
        return self._affine(
            1.0, float(self.target.amin().clamp(min=0)) / self.settings.layout.level_height_um
        )

    @cached_property
    def _best_affine(self) -> Tensor:
        """Return the levels ``gain * height + zero``, shape (size, size). The gain and the zero minimise the
        loss over the printers of the search.
        """
        layout, heights = self.settings.layout, self.printer.level_heights_um()
        top, span = layout.levels - 1, float(np.ptp(self.inputs["relief_um"])) / layout.level_height_um
        unit = top * layout.level_height_um / (heights[-1] - heights[0])

        def error(given: Sequence[float]) -> float:
            return self._expected(self.cells.average(self._affine(*given)))

        coarse = [(g * unit, zero * (top - g * unit * span)) for g in _AFFINE_GAINS for zero in _AFFINE_ZEROS]
        gain, zero = min(coarse, key=error)
        corners = [(gain, zero), (1.05 * gain, zero), (gain, zero + 1)]
        options = {"maxfev": _AFFINE_STEPS, "initial_simplex": corners}
        return self._affine(*minimize(error, (gain, zero), method="Nelder-Mead", options=options).x)

    def _affine(self, gain: float, zero: float) -> Tensor:
        """Return the levels ``gain * (height above the lowest point) + zero``, rounded and limited to the
        printable levels. The result has shape (size, size).
        """
        layout = self.settings.layout
        level = gain * (self.target - self.target.amin()) / layout.level_height_um + zero
        return self.cells(self.cells.average(level).round().clamp(0, layout.levels - 1))

    @torch.no_grad()
    def _expected(self, levels: Tensor) -> float:
        """Round ``levels``, one real level per cell. Return the loss of the rounded levels, combined over the
        printers of the search.
        """
        whole = self.cells(levels.round())[None, None].float()
        losses = torch.stack([self.loss_by(one, self.printed(whole, one))[0] for one in self.printers])
        return float(self.over_models(losses))

    def thick_score(self, height_um: Tensor) -> None:
        """Return None, because heights do not depend on the light."""
        return

    def arrays(self, level: Tensor, height_um: Tensor) -> dict[str, np.ndarray]:
        """Return the arrays that every task saves, and a map of the height error of the best unrounded
        levels. No layout can remove this error.
        """
        left = self.target - self._free_print
        return super().arrays(level, height_um) | {UNPRINTABLE_FILE: (left - left.mean()).cpu().numpy()}

    @cached_property
    def _free_print(self) -> Tensor:
        """Return the print, µm, of the unrounded levels with the lowest loss."""
        free = DirectLevels(self.settings.layout).to(self.printer.device)
        free.start_from(self._levels_printing(self.printer.level_heights_um(), self._asked))

        def loss() -> tuple[Tensor, Tensor]:
            print_um = self.printed(free.sample(), self.printer)
            return self.loss(print_um), print_um.detach()

        rate = self.settings.search.learning_rate * free.rate_unit
        steps: Any = {"rate": rate, "iterations": _FREE_ITERATIONS, "project": free.project}
        return descended(free.parameters(), loss, **steps)[0]

    def _levels_printing(
        self, level_heights_um: Sequence[float], relief_um: Tensor, zero: float = 0.5
    ) -> Tensor:
        """Return one real level per cell. The levels are chosen so that they would print the heights of a
        relief if level k always had the printed height ``level_heights_um[k]``.

        ``zero`` is the position of the relief within the printable heights. At 0, the lowest point of the
        relief is printed with the lowest level; at 1, the highest point is printed with the highest level.
        """
        heights, target = np.asarray(level_heights_um), relief_um.cpu().numpy()
        room_um = (heights[-1] - heights[0]) - np.ptp(target)
        lifted = target - target.min() + heights[0] + zero * room_um
        levels = np.interp(lifted, heights, np.arange(len(heights)))
        return self.cells.average(torch.from_numpy(levels).float().to(self.printer.device))

    def display(self, seen: np.ndarray) -> np.ndarray:
        """Scale heights to the range of the target."""
        target = self.inputs["relief_um"]
        return (seen - seen.min()) / np.ptp(target)
