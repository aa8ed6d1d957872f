"""The hologram as a task: from levels on the pixels to a loss, a score and what is kept."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_design.holograms.baselines import best_signal_efficiency, hologram_baselines
from litho_design.holograms.bench import HologramBench, HologramScore
from litho_design.holograms.loss import hologram_loss
from litho_design.holograms.settings import HologramSettings
from litho_design.images.similarity import SSIM_WINDOW_PX, si_psnr_db
from litho_design.images.targets import Target, stroke_width_px
from litho_design.optimisation.parameters import CellMap, Parametrisation
from litho_design.optimisation.phases import printed_phase
from litho_design.optimisation.process_window import Draw, check_draws, draws
from litho_design.optimisation.robust import penalised, windowed_loss
from litho_design.optimisation.starts import Scene, check_start, start_search
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.tasks.design import IMAGE_FILE, TARGET_FILE, TaskName


class HologramTask:
    """A hologram, ready for ``run_design``.

    Args:
        settings: geometry, optics, search and loss (see ``hologram_settings``).
        printer: frozen model, or nominal heights.
        target: wanted image of the size of the element.
        ensemble: further models: the loss is the mean over all, plus a penalty on their disagreement.

    Raises:
        InputError: a target of another size or without dark and bright pixels, a start for lenses, or
            spreads beyond the range of the propagator.
    """

    name: TaskName = "hoe"

    def __init__(
        self,
        settings: HologramSettings,
        printer: Printer,
        target: Target,
        ensemble: Sequence[Printer] = (),
    ):
        _check_target(target.pixels, settings.layout)
        check_start(settings.search.start, "hologram")
        device, record = printer.device, target.record
        self.settings, self.printer, self.target_record = settings, printer, record
        self.printers = [printer, *ensemble]
        self.notes = [f"target {record.adaptation}"] if record.adaptation else []
        self.notes += _too_fine(target.pixels, settings)
        self.cells = CellMap(settings.layout).to(device)
        self.bench = HologramBench(settings.layout, settings.optics).to(device)
        check_draws(settings.window, settings.optics, self.bench.grid, self.bench.grid)
        self.target = torch.from_numpy(target.pixels).to(device)
        self.scenes: list[tuple[Draw | None, HologramBench]] = [
            (draw, HologramBench(settings.layout, draw.optics).to(device))
            for draw in draws(settings.window, settings.optics, settings.window.samples)
        ] or [(None, self.bench)]

    def objective(self, level: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Loss of the printed hologram's image (see ``hologram_loss``), of levels on the pixels.

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
            loss, _ = hologram_loss(share, self.target, self.settings.loss)
            scores.append(
                {
                    "loss": float(loss),
                    "si_psnr_db": si_psnr_db(share.double(), self.target.double()),
                    "eff_signal": float(share[self.target > 0.5].sum()),
                }
            )
        return scores

    def _loss(self, height_um: Tensor, bench: HologramBench) -> tuple[Tensor, dict[str, float]]:
        return hologram_loss(bench(height_um), self.target, self.settings.loss)

    def start(self, parameters: Parametrisation, level_heights_um: list[float]) -> None:
        """Set the start of the search, from the phases of the levels as printed."""
        search, optics = self.settings.search, self.settings.optics
        scene = Scene(
            cells=self.cells,
            pitch_um=self.settings.layout.pitch_um,
            optics=optics,
            level_phase=printed_phase(level_heights_um, optics).to(self.target),
            iterations=search.start_iterations,
            seed=search.seed,
            target=self.target,
            propagator=self.bench.propagator,
        )
        start_search(parameters, search.start, scene, jitter_levels=search.start_jitter_levels)

    def score(self, height_um: Tensor) -> HologramScore:
        """Score of the image behind a print (size, size), µm."""
        return self.bench.score(height_um, self.target, self.settings.camera)

    @torch.no_grad()
    def arrays(self, height_um: Tensor) -> dict[str, np.ndarray]:
        """Image (share of incident power per pixel) and target."""
        return {IMAGE_FILE: self.bench(height_um).cpu().numpy(), TARGET_FILE: self.target.cpu().numpy()}

    def reference_efficiency(self, height_um: Tensor) -> float:
        """Signal efficiency of the best continuous phase found from the print, power alone counting."""
        return best_signal_efficiency(self.bench, height_um, self.target)

    def baselines(self) -> dict[str, dict[str, float]]:
        """Scores of a black image and of ideal elements on the same grid."""
        return hologram_baselines(self.bench, self.cells, self.target, self.settings)


def _too_fine(target: np.ndarray, settings: HologramSettings) -> list[str]:
    """A note where diffraction blurs the strokes of the target, whatever the layout is."""
    layout, optics = settings.layout, settings.optics
    stroke_um = stroke_width_px(target) * layout.pitch_um
    finest_um = optics.wavelength_um * optics.distance_um / layout.size_um
    if stroke_um >= finest_um:
        return []
    near_um = stroke_um / finest_um * optics.distance_um
    return [
        f"strokes of the target are about {stroke_um:.2g} µm wide, narrower than λz/D = {finest_um:.2g} µm, "
        f"the finest detail that an element of {layout.size_um:.4g} µm draws at {optics.distance_um:g} µm: "
        f"the image will be blurred; take --distance-um {near_um:.2g} or less, a larger --size-px, or "
        "bolder strokes"
    ]


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
