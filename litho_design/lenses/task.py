"""The lens as a task: from levels on the pixels to a loss, a score and what is kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_design.images.targets import TargetRecord
from litho_design.lenses.bench import (
    LensBench,
    RadialLensBench,
    centre_to_background,
    reconstruct,
    record,
    sensor_psf,
)
from litho_design.lenses.objects import object_stack, picture_records, pictures_note
from litho_design.lenses.score import (
    ImagingLensScore,
    LensScore,
    lens_baselines,
    lens_score,
    score_lens,
)
from litho_design.lenses.settings import LensSettings
from litho_design.optics import Optics
from litho_design.optimisation.parameters import CellMap, Parametrisation
from litho_design.optimisation.phases import printed_phase
from litho_design.optimisation.process_window import Draw, check_draws, draws
from litho_design.optimisation.robust import penalised, windowed_loss
from litho_design.optimisation.starts import Scene, check_start, start_search
from litho_design.printers.printer import Printer
from litho_design.tasks.design import IMAGE_FILE, PICTURES_FILE, TaskName

# The same noise in every iteration: the search compares layouts, not noise; the score draws its own.
_DESIGN_NOISE_SEED = 0
_PLANE_NOTE = (
    "the search ran on the whole plane, not along a radius: the printer's effects depend on the position"
)


class LensTask:
    """A lens, ready for ``run_design``.

    Args:
        settings: geometry, optics, task and search (see ``lens_settings``).
        printer: frozen model, or nominal heights.
        ensemble: further models: the loss is the mean over all, plus a penalty on their disagreement.
        pictures: pixels of the objects that are pictures (see ``with_objects``).

    Raises:
        InputError: a radial search of a layout without rings or with a square aperture, a start for
            holograms, an object without pixels, or spreads beyond the range of the propagator.
    """

    target_record: TargetRecord | None = None

    def __init__(
        self,
        settings: LensSettings,
        printer: Printer,
        ensemble: Sequence[Printer] = (),
        pictures: Mapping[str, np.ndarray] | None = None,
    ):
        _check(settings)
        self.settings, self.printer = settings, printer
        self.printers = [printer, *ensemble]
        self.name: TaskName = "lens-direct" if settings.task == "direct" else "lens-computational"
        device = printer.device
        self.cells = CellMap(settings.layout).to(device)
        self.bench = LensBench(settings.layout, settings.optics, settings.view).to(device)
        check_draws(settings.window, settings.optics, self.bench.grid, self.bench.window)
        rings, placed = settings.view.path == "radial", any(p.depends_on_position for p in self.printers)
        self.radial = rings and not placed
        self.notes = [_PLANE_NOTE] if rings and placed else []
        self.notes += _narrow_window(self.bench)
        self.strips = (
            [_strip_rings(self.cells, p.strip_halo_px) for p in self.printers] if self.radial else []
        )
        self.scenes: list[tuple[Draw | None, LensBench | RadialLensBench]] = [
            (draw, self._search_bench(draw.optics))
            for draw in draws(settings.window, settings.optics, settings.window.samples)
        ] or [(None, self._search_bench(settings.optics))]
        imaging = settings.imaging
        self.pictures = dict(pictures or {})
        self.objects = object_stack(imaging.objects, imaging.object_px, self.pictures).to(device)
        self.notes += pictures_note(imaging.objects, imaging.test_objects)

    def objective(self, level: Tensor) -> tuple[Tensor, dict[str, float]]:
        """-log(centre-to-background ratio), or the mean absolute error after Richardson-Lucy.

        With process-window samples: the risk of that loss over them; with an ensemble: its mean over
        the models, and their disagreement.
        """
        prints = (
            [self.printed_rings(level, index) for index in range(len(self.printers))]
            if self.radial
            else [printer(level)[0, 0] for printer in self.printers]
        )
        settings = self.settings
        loss, parts = windowed_loss(
            prints, self.scenes, self._loss, settings.window, settings.layout.pitch_um
        )
        bench = self.scenes[0][1]
        area = bench.propagator.ring_area_um2.to(loss) if isinstance(bench, RadialLensBench) else None
        wave_um = settings.optics.wave_height_um
        return penalised(loss, prints, settings.ensemble.weight, wave_um, area), parts

    def _loss(self, height_um: Tensor, bench: LensBench | RadialLensBench) -> tuple[Tensor, dict[str, float]]:
        psf = bench(height_um)
        layout = self.settings.layout
        centre_px = round(self.settings.view.centre_um / layout.pitch_um)
        ratio = centre_to_background(psf, centre_px, layout.size_px)
        parts = {"cbr": float(ratio.detach()), "window": float(psf.detach().sum())}
        if self.settings.task == "direct":
            return -ratio.log(), parts
        imaging = self.settings.imaging
        kernel = sensor_psf(psf, imaging.pixel_px)
        seen = record(self.objects, kernel, imaging.read_noise, _DESIGN_NOISE_SEED)
        error = (reconstruct(seen, kernel, imaging.iterations) - self.objects).abs().mean()
        return error, parts

    def start(self, parameters: Parametrisation, level_heights_um: list[float]) -> None:
        """Set the start of the search, from the phases of the levels as printed."""
        settings, search = self.settings, self.settings.search
        scene = Scene(
            # On the CPU, where sums over rings are reproducible.
            cells=CellMap(settings.layout),
            pitch_um=settings.layout.pitch_um,
            optics=settings.optics,
            level_phase=printed_phase(level_heights_um, settings.optics),
            iterations=search.start_iterations,
            seed=search.seed,
        )
        start_search(parameters, search.start, scene, jitter_levels=search.start_jitter_levels)

    def score(self, height_um: Tensor) -> LensScore | ImagingLensScore:
        """Score of a print, expected PSF and printed PSF being the same."""
        return score_lens(self.settings, self.bench, height_um, height_um, self.pictures)

    @torch.no_grad()
    def arrays(self, height_um: Tensor) -> dict[str, np.ndarray]:
        """The PSF, and the pictures (n, object, object) in the order of ``picture_records``."""
        arrays = {IMAGE_FILE: self.bench(height_um).cpu().numpy()}
        imaging = self.settings.imaging
        records = picture_records((*imaging.objects, *imaging.test_objects))
        if records:
            arrays[PICTURES_FILE] = object_stack(records, imaging.object_px, self.pictures).numpy()
        return arrays

    def reference_efficiency(self, height_um: Tensor) -> float:
        """Focusing efficiency of a perfect lens of this aperture, whatever the print."""
        return lens_score(self.bench, self.bench.ideal_height_um()).focusing_efficiency

    def baselines(self) -> dict[str, dict[str, float]]:
        """Scores of a perfect lens, of no lens, and of black images on the same grid."""
        return lens_baselines(self.settings, self.bench, self.pictures)

    @torch.no_grad()
    def window_scores(self, height_um: Tensor, count: int) -> list[dict[str, float]]:
        """Strehl ratio and centre-to-background ratio of a print over ``count`` unseen draws."""
        settings, scores = self.settings, []
        peak = float(self.bench(self.bench.ideal_height_um()).max())
        centre_px = round(settings.view.centre_um / settings.layout.pitch_um)
        for draw in draws(settings.window, settings.optics, count, unseen=True):
            bench = LensBench(settings.layout, draw.optics, settings.view).to(height_um.device)
            psf = bench(draw.apply(height_um, settings.layout.pitch_um))
            cbr = centre_to_background(psf, centre_px, settings.layout.size_px)
            scores.append({"strehl": float(psf.max()) / peak, "cbr": float(cbr)})
        return scores

    def _search_bench(self, optics: Optics) -> LensBench | RadialLensBench:
        kind = RadialLensBench if self.radial else LensBench
        return kind(self.settings.layout, optics, self.settings.view).to(self.printer.device)

    def printed_rings(self, level: Tensor, printer: int = 0) -> Tensor:
        """Height (rings,), µm, inside the aperture, from one printer's print of a strip along a radius.

        The strip continues the rings beyond the aperture, as the layout's corners do.
        """
        rings = self.cells.average(level[0, 0])
        press = self.printers[printer]
        strip = rings[self.strips[printer]][None, None]
        return press.print_patch(strip, press.strip_halo_px)[0, 0].mean(0)


def _narrow_window(bench: LensBench) -> list[str]:
    """A note where the PSF window is narrower than the focusing circle."""
    # Airy disc: full width at half maximum 0.514 wavelength / NA; the circle's radius is three of them.
    radius_um = 3 * 0.514 * bench.optics.wavelength_um / bench.numerical_aperture
    window_um, enough_px = bench.window.size_um[0], math.ceil(2 * radius_um / bench.layout.pitch_um)
    if window_um >= 2 * radius_um:
        return []
    return [
        f"the PSF window of {window_um:.1f} µm is narrower than the focusing circle (radius "
        f"{radius_um:.1f} µm), so the focusing efficiency leaves light out; use --window-px {enough_px}"
    ]


def _strip_rings(cells: CellMap, halo_px: int) -> Tensor:
    """Ring under each pixel of the strip: two central rows, rings 0 to the aperture, a halo all round."""
    assert cells.radial
    along = torch.arange(-halo_px, cells.size_px // 2 + halo_px, dtype=torch.float64) + 0.5
    across = torch.arange(-halo_px - 1, halo_px + 1, dtype=torch.float64) + 0.5
    ring = (torch.hypot(across[:, None], along[None, :]) / cells.cell_px).floor().long()
    return ring.clamp(max=cells.cells[0] - 1).to(cells.ring.device)


def _check(settings: LensSettings) -> None:
    check_start(settings.search.start, "lens")
    radial = settings.view.path == "radial"
    if radial and (settings.layout.symmetry != "radial" or settings.view.aperture != "circle"):
        raise InputError(
            "search path 'radial'",
            got=f"symmetry {settings.layout.symmetry!r}, aperture {settings.view.aperture!r}",
            wanted="a ring layout behind a circular aperture",
        )
    if radial and settings.layout.size_px % 2:
        raise InputError("size_px for the radial path", got=settings.layout.size_px, wanted="an even number")
