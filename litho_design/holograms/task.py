"""The task of a hologram, which turns levels on the pixels into a loss, a score and the saved arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_design.holograms.baselines import best_signal_efficiency, hologram_baselines
from litho_design.holograms.bench import HologramBench, HologramScore, WindowedHologramScore
from litho_design.holograms.loss import counted_pixels, hologram_loss
from litho_design.holograms.settings import HologramSettings
from litho_design.images.similarity import SSIM_WINDOW_PX, si_psnr_db
from litho_design.images.targets import TargetRecord, stroke_width_px
from litho_design.optics import Optics
from litho_design.optimisation.phases import gerchberg_saxton, nearest_levels
from litho_design.optimisation.process_window import allowed_defocus_um, rounded_down
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.tasks.task import Task, register_task

_START_ITERATIONS = 40


@register_task
class HologramTask(Task):
    """The task of designing a hologram, for ``run_design``.

    Args:
        settings: geometry, optics, search and loss (see ``hologram_settings``).
        printer: printer that predicts prints with a frozen model, or that prints nominal heights.
        inputs: contains ``target``, the target image at the size of the element. ``load_target`` returns this
            image and its record.
        ensemble: further models in the loss, as for ``Task``.

    Raises:
        InputError: the target does not have the size of the element or lacks dark or bright pixels, the task
            does not support the start in the settings, or the propagator is not valid for some draw of the
            process window.
    """

    name = "hoe"
    starts = ("random", "gs", "wgs")
    headline = ("si_psnr_db", "ssim", "ssim_camera", "eff_signal", "speckle_contrast")
    errors = ("rmse_paper", "zero_order_share", "clipped_share", "speckle_contrast")
    score_type = WindowedHologramScore
    settings_type = HologramSettings
    settings: HologramSettings
    bench: HologramBench
    # This function sums over the pixels of the whole element. The target and the cells of this process may
    # cover only a part of the element.
    total: Callable[[Tensor], Tensor] = staticmethod(torch.sum)

    def __init__(
        self,
        settings: HologramSettings,
        printer: Printer,
        *,
        inputs: Mapping[str, np.ndarray],
        ensemble: Sequence[Printer] = (),
        record: TargetRecord | None = None,
    ):
        target = inputs["target"]
        check_target(target, settings.layout)
        super().__init__(settings, printer, inputs=inputs, ensemble=ensemble, record=record)
        if settings.loss.signal_window_um:
            self.headline = ("si_psnr_window_db", *self.headline[1:])  # type: ignore[misc]
        self.notes += [f"target {record.adaptation}"] if record and record.adaptation else []
        self.notes += self._too_fine(target)
        self.target = torch.from_numpy(target).to(printer.device)
        self.counted = counted_pixels(self.target, settings.loss, settings.layout.pitch_um)

    def make_bench(self, optics: Optics) -> HologramBench:
        """Return the bench, which propagates from the element to the image plane."""
        return HologramBench(self.settings.layout, optics).to(self.printer.device)

    def loss(self, seen: Tensor) -> tuple[Tensor, dict[str, float]]:
        """See ``hologram_loss``."""
        return hologram_loss(seen, self.target, self.settings.loss, self.counted, self.total)

    def window_figures(self, seen: Tensor) -> dict[str, float]:
        """Return the loss, the SI-PSNR and the signal efficiency of an image."""
        figures = {
            "loss": float(self.loss(seen)[0]),
            "si_psnr_db": si_psnr_db(seen.double(), self.target.double()),
            "eff_signal": float(seen[self.target > 0.5].sum()),
        }
        return figures | self._inside_window(seen)

    def start_levels(self, level_phase: Tensor) -> Tensor:
        """Return the levels whose printed phases are nearest to the phases that ``gerchberg_saxton`` finds.
        If the start is ``wgs``, the weighted form of the algorithm is used.
        """
        search = self.settings.search
        phase, _ = gerchberg_saxton(
            self.bench.propagator, self.target, self.cells, self.bench.illumination(),
            iterations=_START_ITERATIONS, weighted=search.start == "wgs", seed=search.seed,
            level_phase=level_phase, counted=self.counted, total=self.total,
        )  # fmt: skip
        return nearest_levels(phase, level_phase)

    def score(self, height_um: Tensor, expected_um: Tensor | None = None) -> HologramScore:
        """Return the score of the image behind a print, which is given as heights in µm of shape
        (size, size).
        """
        score = self.bench.score(height_um, self.target)
        if self.counted is None:
            return score
        with torch.no_grad():
            return WindowedHologramScore(**score.model_dump(), **self._inside_window(self.bench(height_um)))

    def _too_fine(self, target: np.ndarray) -> list[str]:
        """Return a list with one note if the lines of the target are so narrow that diffraction blurs them,
        whatever the layout. Otherwise, return an empty list.
        """
        layout, optics, window = self.settings.layout, self.settings.optics, self.settings.window
        stroke_um = stroke_width_px(target) * layout.pitch_um
        finest_um = optics.wavelength_um * optics.distance_um / layout.size_um
        if stroke_um >= finest_um:
            return []
        # The advised distance is rounded down, so that no line is too narrow at this distance.
        near_um = rounded_down(stroke_um / finest_um * optics.distance_um)
        near = optics.model_copy(update={"distance_um": near_um})
        # If the advised distance is small, the defocus in some draws of the process window would move the
        # image plane in front of the element.
        calm_um = allowed_defocus_um(window, near, self.bench.grid, self.bench.window)
        defocus = "or less" if calm_um == window.defocus_sd_um else f"with --defocus-sd-um {calm_um:.2g}"
        closer = f"--distance-um {near_um:.2g} {defocus}, " if calm_um else ""
        return [
            f"the image will be blurred: the lines of the target are about {stroke_um:.2g} µm wide, but an "
            f"element of {layout.size_um:.4g} µm at {optics.distance_um:g} µm resolves no detail finer than "
            f"λz/D = {finest_um:.2g} µm; use {closer}a larger --size-px, or thicker lines"
        ]

    def _inside_window(self, seen: Tensor) -> dict[str, float]:
        if self.counted is None:
            return {}
        found = si_psnr_db(seen[self.counted].double(), self.target[self.counted].double())
        return {"si_psnr_window_db": found}

    def reference_efficiency(self, height_um: Tensor) -> float:
        """Return the signal efficiency of an ideal element, i.e. an element whose continuous phase sends the
        most power to the signal. The search for this phase starts from the print.
        """
        return best_signal_efficiency(self.bench, height_um, self.target)

    def baselines(self) -> dict[str, dict[str, float]]:
        """Return the scores of a black image and of ideal elements on the same grid."""
        return hologram_baselines(self.bench, self.cells, self.target, self.settings)

    def display(self, seen: np.ndarray) -> np.ndarray:
        """Return the image, scaled to match its target."""
        target = self.inputs["target"]
        return (seen * target).sum() / max(float((seen**2).sum()), 1e-30) * seen


def check_target(target: np.ndarray, layout: LayoutSettings) -> None:
    """Check that a hologram can show a target.

    Raises:
        InputError: the element is smaller than the SSIM window, or the target does not have the size of the
            element, has values outside [0, 1], or lacks dark or bright pixels.
    """
    if layout.size_px < SSIM_WINDOW_PX:
        raise InputError(
            "size_px of a hologram",
            got=layout.size_px,
            wanted=f"at least {SSIM_WINDOW_PX}, the side of the SSIM window",
        )
    wanted = (layout.size_px, layout.size_px)
    if target.shape != wanted:
        raise InputError("target", got=f"{target.shape} px", wanted=f"{wanted} px, the size of the element")
    if not np.isfinite(target).all() or target.min() < 0 or target.max() > 1 or target.max() == 0:
        raise InputError(
            "target", got="values outside [0, 1] or no light", wanted="an image in [0, 1] with light"
        )
    # The scores compare the signal, which is brighter than 0.5 in the target, with its surroundings.
    share = float((target > 0.5).mean())
    if share in (0.0, 1.0):
        raise InputError(
            "target",
            got=f"{100 * share:.0f} % of its pixels above half brightness",
            wanted="a bright image on a dark background",
        )
