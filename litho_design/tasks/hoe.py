"""Design a holographic element through a frozen model of the printer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_design.judging.metrics import SSIM_WINDOW_PX, HologramScore, si_psnr_db
from litho_design.optimisation.initialise import gerchberg_saxton, printed_phase
from litho_design.optimisation.parametrise import CellMap, LayoutSettings, Parametrisation, nearest_levels
from litho_design.optimisation.robust import YIELD_DRAWS, Draw, check_draws, draws, windowed_loss
from litho_design.printers.ensemble import penalised
from litho_design.printers.printer import Printer
from litho_design.reports.design import write_hologram_report
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, TARGET_FILE, Design, DesignTask
from litho_design.tasks.hologram import HologramBench, image_error
from litho_design.tasks.settings import HoeSettings
from litho_design.tasks.targets import TargetRecord
from litho_design.tasks.task import run_design

_REFERENCE_ITERATIONS = 40


def design_hoe(
    settings: HoeSettings,
    printer: Printer,
    target: np.ndarray,
    target_record: TargetRecord,
    out: str | Path,
    *,
    ensemble: Sequence[Printer] = (),
    announce: bool = True,
) -> Design:
    """Optimise the layout of a hologram so that its print shows the wanted image.

    Args:
        settings: geometry, optics, search and loss (see ``hoe_preset``).
        printer: frozen model, or nominal heights.
        target: wanted image (size_px, size_px) in [0, 1].
        out: folder of the design; an interrupted run in it is continued.
        ensemble: further models: the loss is the mean over all, plus what they disagree by.

    Returns:
        The record written to ``out/design.json``.

    Raises:
        InputError: a target of another size or without dark and bright pixels, or a folder that holds
            another design.
    """
    _check_target(target, settings.layout)
    task = HoeTask(settings, printer, target, target_record, ensemble)
    return run_design(task, settings, settings, out, announce=announce)


class HoeTask:
    """The hologram as a task for ``run_design``."""

    name: DesignTask = "hoe"

    def __init__(
        self,
        settings: HoeSettings,
        printer: Printer,
        target: np.ndarray,
        record: TargetRecord,
        ensemble: Sequence[Printer] = (),
    ):
        device = printer.device
        if settings.search.start == "fresnel":
            raise InputError("start", got="'fresnel'", wanted="'random', 'gs' or 'wgs' for a hologram")
        self.settings, self.printer, self.target_record = settings, printer, record
        self.printers = [printer, *ensemble]
        self.notes = [f"target {record.adaptation}"] if record.adaptation else []
        self.cells = CellMap(settings.layout).to(device)
        self.bench = HologramBench(settings.layout, settings.optics).to(device)
        check_draws(settings.window, settings.optics, self.bench.grid, self.bench.grid)
        self.target = torch.from_numpy(target).to(device)
        self.scenes: list[tuple[Draw | None, HologramBench]] = [
            (draw, HologramBench(settings.layout, draw.optics).to(device))
            for draw in draws(settings.window, settings.optics, settings.window.samples)
        ] or [(None, self.bench)]

    def objective(self, level: Tensor) -> tuple[Tensor, dict[str, float]]:
        """RMSE of the printed hologram's image + weight * (1 - efficiency), of levels on the pixels.

        With process-window samples: the risk of that loss over them; with an ensemble: its mean over
        the models, and their disagreement.
        """
        prints = [printer(level)[0, 0] for printer in self.printers]
        settings = self.settings
        loss, parts = windowed_loss(
            prints, self.scenes, self._loss, settings.window, settings.layout.pitch_um
        )
        wave_um = settings.optics.wave_height_um
        return penalised(loss, prints, settings.ensemble.weight, wave_um), parts

    @torch.no_grad()
    def window_scores(self, height_um: Tensor, count: int) -> list[dict[str, float]]:
        """Loss, SI-PSNR and signal efficiency of a print (size, size) over ``count`` unseen draws."""
        scores = []
        for draw in draws(self.settings.window, self.settings.optics, count, unseen=True):
            bench = HologramBench(self.settings.layout, draw.optics).to(height_um.device)
            changed = draw.apply(height_um, self.settings.layout.pitch_um)
            share = bench(changed)
            loss, _ = self._loss(changed, bench)
            scores.append(
                {
                    "loss": float(loss),
                    "si_psnr_db": si_psnr_db(share.double(), self.target.double()),
                    "eff_signal": float(share[self.target > 0.5].sum()),
                }
            )
        return scores

    def _loss(self, height_um: Tensor, bench: HologramBench) -> tuple[Tensor, dict[str, float]]:
        share = bench(height_um)
        rmse, efficiency = image_error(share, self.target, self.settings.loss.scale)
        total = rmse + self.settings.loss.efficiency_weight * (1 - efficiency)
        return total, {"rmse": float(rmse.detach()), "efficiency": float(efficiency.detach())}

    def start(self, parameters: Parametrisation, level_heights_um: list[float]) -> None:
        """Random, or Gerchberg-Saxton projected on the phases that the levels really print."""
        search = self.settings.search
        if search.start == "random":
            parameters.start_random(search.seed)
            return
        level_phase = printed_phase(level_heights_um, self.settings.optics).to(self.target)
        phase, _ = gerchberg_saxton(
            self.bench.propagator,
            self.target,
            self.cells,
            iterations=search.start_iterations,
            weighted=search.start == "wgs",
            seed=search.seed,
            level_phase=level_phase,
        )
        parameters.start_from(nearest_levels(phase, level_phase).float())

    def score(self, height_um: Tensor) -> HologramScore:
        """All figures of the image behind a print (size, size), µm."""
        return self.bench.score(height_um, self.target, self.settings.camera)

    @torch.no_grad()
    def arrays(self, height_um: Tensor) -> dict[str, np.ndarray]:
        """Image (share of incident power per pixel) and target."""
        return {IMAGE_FILE: self.bench(height_um).cpu().numpy(), TARGET_FILE: self.target.cpu().numpy()}

    @torch.no_grad()
    def reference_efficiency(self) -> float:
        """Signal efficiency of a continuous-phase Gerchberg-Saxton element with the same cells."""
        phase, _ = gerchberg_saxton(
            self.bench.propagator,
            self.target,
            self.cells,
            iterations=_REFERENCE_ITERATIONS,
            weighted=False,
            seed=self.settings.search.seed,
        )
        share = self.bench(self.cells(phase) * (self.settings.optics.wave_height_um / (2 * math.pi)))
        return float(share[self.target > 0.5].sum())

    def report(self, folder: Path, design: Design, history: list[dict[str, float]]) -> None:
        """Write report.html."""
        height = torch.from_numpy(np.load(folder / HEIGHT_FILE)).to(self.target.device)
        write_hologram_report(folder, design, history, self.window_scores(height, YIELD_DRAWS))


def _check_target(target: np.ndarray, layout: LayoutSettings) -> None:
    if layout.size_px < SSIM_WINDOW_PX:
        raise InputError(
            "size_px of a hologram",
            got=layout.size_px,
            wanted=f"at least {SSIM_WINDOW_PX}, the window of SSIM",
        )
    wanted = (layout.size_px, layout.size_px)
    if target.shape != wanted:
        raise InputError("target", got=f"{target.shape} px", wanted=f"{wanted} px, the size of the element")
    if not np.isfinite(target).all() or target.min() < 0 or target.max() > 1 or target.max() == 0:
        raise InputError("target", got="values outside [0, 1] or no light", wanted="an image in [0, 1]")
    # The scores compare the signal {T > 0.5} with what is around it.
    share = float((target > 0.5).mean())
    if share in (0.0, 1.0):
        raise InputError(
            "target",
            got=f"{100 * share:.0f} % of its pixels above half brightness",
            wanted="a bright image on a dark background",
        )
