"""The tasks of lenses, which turn levels on the pixels into a loss, a score and the saved arrays."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from litho_data.foundation.errors import InputError
from litho_design.images.targets import TargetRecord
from litho_design.lenses.bench import (
    LensBench,
    RadialLensBench,
    record,
    sensor_psf,
)
from litho_design.lenses.objects import PICTURES, object_stack, pictures_note
from litho_design.lenses.score import (
    ImagingLensScore,
    LensScore,
    black_images,
    imaging_score,
    lens_score,
)
from litho_design.lenses.settings import SMOOTH_BELOW, LensSettings
from litho_design.optics import Optics
from litho_design.optics.imaging import richardson_lucy
from litho_design.optimisation.phases import focusing_levels, fresnel_lens_phase
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.tasks.task import Task, register_task

# Names of the scores that are defined even if the lens does not focus.
_OF_POWER = {"focusing_efficiency", "strehl", "cbr", "eff_window"}
# The sensor noise is the same in every iteration, so that the search compares layouts and not noise. Scores
# use other seeds.
_DESIGN_NOISE_SEED = 0
_PLANE_NOTE = (
    "the search ran on the whole plane, not along a radius, because the printer's effects depend on the "
    "position"
)


def lens_task(settings: LensSettings, printer: Printer, **given: Any) -> LensTask:
    """Make the task that ``settings.task`` names, with the arguments and errors of ``LensTask``."""
    kind = DirectLensTask if settings.task == "direct" else ComputationalLensTask
    return kind(settings, printer, **given)


class LensTask(Task):
    """The base class of the tasks of direct and computational lenses, which ``run_design`` runs.

    Args:
        settings: geometry, optics, task and search (see ``lens_settings``).
        printer: printer that predicts prints with a frozen model, or that prints nominal heights.
        ensemble: further models that contribute to the loss, as for ``Task``.
        inputs: the pixels of the pictures among the objects, as ``with_objects`` returns them.

    Raises:
        InputError: ``check_lens`` rejects the settings; this task does not support the start in the settings;
            the pixels of an object are missing; or the propagator is not valid for some draw of the process
            window.
    """

    starts = ("random", "fresnel")
    start_jitter_levels = 0.3
    errors = (
        "fwhm_um",
        "mae_direct",
        "mae_design",
        "mae_calibrated",
        "mae_calibrated_sd",
        "ssim_calibrated_sd",
    )
    settings_type = LensSettings
    settings: LensSettings
    bench: LensBench

    def __init__(
        self,
        settings: LensSettings,
        printer: Printer,
        *,
        inputs: Mapping[str, np.ndarray] | None = None,
        ensemble: Sequence[Printer] = (),
        record: TargetRecord | None = None,
    ):
        check_lens(settings, radial=settings.view.path == "radial")
        imaging = settings.imaging
        objects = (*imaging.objects, *imaging.test_objects)
        pictures = (inputs or {}).get(PICTURES, ())
        stack = object_stack(objects, imaging.object_px, pictures).to(printer.device)
        self.objects, self.tested = stack[: len(imaging.objects)], stack[len(imaging.objects) :]
        super().__init__(settings, printer, inputs=inputs, ensemble=ensemble, record=record)
        rings, placed = settings.view.path == "radial", any(p.depends_on_position for p in self.printers)
        self.radial = rings and not placed
        self.notes += [_PLANE_NOTE] if rings and placed else []
        self.notes += _narrow_window(self.bench)
        self.notes += pictures_note(imaging.objects, imaging.test_objects)

    def make_bench(self, optics: Optics) -> LensBench:
        """Return the bench, which propagates from the element to the focal window."""
        return LensBench(self.settings.layout, optics, self.settings.view).to(self.printer.device)

    def search_bench(self, optics: Optics) -> LensBench | RadialLensBench:
        """If the settings request a search along a radius and the prints do not depend on the position in the
        write field, return a bench that computes along a radius. Otherwise, return a bench of the whole
        plane.
        """
        if not self.radial:
            return self.make_bench(optics)
        if optics.element == "thick":
            hint = "use --set view.path=plane"
            raise InputError(
                "search path 'radial'", got="a thick element", wanted="a thin element", hint=hint
            )
        return RadialLensBench(self.settings.layout, optics, self.settings.view).to(self.printer.device)

    def search_print(self, level: Tensor, printer: Printer) -> Tensor:
        """Return the printed height, µm, of the rings, shape (rings,), or of the plane, shape
        (size, size).
        """
        return self.printed_rings(level, printer) if self.radial else self.printed(level, printer)

    def search_area(self) -> Tensor | None:
        """Return the area of each ring, or None if the search runs on the plane."""
        bench = self.scenes[0][1]
        if not isinstance(bench, RadialLensBench):
            return None
        return bench.propagator.ring_area_um2.float().to(self.printer.device)

    def start_levels(self, level_phase: Tensor) -> Tensor:
        """Return the levels whose printed phases come closest to the phases of a perfect lens.

        The levels are computed on the CPU, so that sums over rings are reproducible.
        """
        phase = fresnel_lens_phase(self.cells.cpu(), self.settings.layout.pitch_um, self.settings.optics)
        self.cells.to(self.printer.device)
        return focusing_levels(phase, level_phase.cpu())

    def score(self, height_um: Tensor, expected_um: Tensor | None = None) -> LensScore:
        """Return the scores of the PSF behind a print, which is given as heights in µm of shape (size,
        size).
        """
        return lens_score(self.bench, height_um)

    def baselines(self) -> dict[str, dict[str, float]]:
        """Return the scores of a perfect lens and of a flat plate on the same grid."""
        ideal = self.bench.ideal_height_um()
        flat = lens_score(self.bench, torch.zeros_like(ideal)).model_dump(include=_OF_POWER)
        perfect = copy.copy(self)
        perfect.bench = self.bench.thin()
        return {"perfect lens": perfect.score(ideal).model_dump(), "no lens": flat}

    def window_figures(self, seen: Tensor) -> dict[str, float]:
        """Return the Strehl ratio and the centre-to-background ratio of a PSF."""
        return {"strehl": float(seen.max()) / self._ideal_peak, "cbr": float(self.bench.ratio(seen))}

    def display(self, seen: np.ndarray) -> np.ndarray:
        """Return the PSF as an image for reports: sqrt(PSF / peak)."""
        return np.sqrt(seen / seen.max())

    def printed_rings(self, level: Tensor, printer: Printer) -> Tensor:
        """Predict the print of a strip along one radius, and return the heights, µm, of the rings inside the
        aperture. The result has shape (rings,).

        Beyond the aperture, the strip has the same levels as the corners of the layout.
        """
        rings, halo = self.cells.average(level[0, 0]), printer.strip_halo_px
        strip = rings[strip_rings(self.settings.layout, halo, len(rings))][None, None]
        return printer.print_patch(strip, halo)[0, 0].mean(0)

    @cached_property
    def _ideal_peak(self) -> float:
        return float(self.bench.ideal_psf().max())


@register_task
class DirectLensTask(LensTask):
    """The task of a lens that focuses light."""

    name = "lens-direct"
    headline = ("cbr", "strehl", "focusing_efficiency", "fwhm_um")
    score_type = LensScore

    def loss(self, seen: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a PSF, which is -log(centre-to-background ratio), and a dict of named values for
        the history of the search.
        """
        return self.bench.focusing_loss(seen)


@register_task
class ComputationalLensTask(LensTask):
    """The task of a lens whose images are deconvolved to reconstruct the objects."""

    name = "lens-computational"
    headline = ("mae_design", "mae_calibrated", "ssim_calibrated", "strehl", "cbr")
    score_type = ImagingLensScore

    def loss(self, seen: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Reconstruct the objects from the sensor images by Richardson-Lucy deconvolution, and return the
        mean error of the reconstructions. Also return a dict with the centre-to-background ratio and the
        share of the power in the PSF window.
        """
        imaging = self.settings.imaging
        kernel = sensor_psf(seen, imaging.pixel_px)
        image = record(self.objects, kernel, imaging, _DESIGN_NOISE_SEED)
        estimate = richardson_lucy(image, kernel, imaging.iterations)
        if imaging.loss == "smooth-l1":
            error = smooth_l1_loss(estimate, self.objects, beta=SMOOTH_BELOW)
        else:
            error = (estimate - self.objects).abs().mean()
        return error, {"cbr": float(self.bench.ratio(seen).detach()), "window": float(seen.detach().sum())}

    def score(self, height_um: Tensor, expected_um: Tensor | None = None) -> ImagingLensScore:
        """Return the scores of the PSF and of the images of the held-out objects.

        ``expected_um`` contains the heights of the expected print, which was predicted when the layout was
        designed. If it is None, the scored print is used.
        """
        with torch.no_grad():
            psf, design_psf = (self.bench(height_um if one is None else one) for one in (None, expected_um))
        tested = imaging_score(psf, design_psf, self.tested, self.settings.imaging)
        return ImagingLensScore(**super().score(height_um).model_dump(), **tested)

    def baselines(self) -> dict[str, dict[str, float]]:
        """Return the scores of the baselines that every lens task has, and the scores of black images."""
        return super().baselines() | {"black image": black_images(self.tested)}


def _narrow_window(bench: LensBench) -> list[str]:
    """Return a list with one note if the PSF window is narrower than the circle in which the focusing
    efficiency is measured. Otherwise, return an empty list.
    """
    # The Airy disc has a full width at half maximum of 0.514 wavelength / NA; the radius of the circle is
    # three times this width.
    radius_um = 3 * 0.514 * bench.optics.wavelength_um / bench.numerical_aperture
    window_um, enough_px = bench.window.size_um[0], math.ceil(2 * radius_um / bench.layout.pitch_um)
    if window_um >= 2 * radius_um:
        return []
    return [
        f"the PSF window of {window_um:.1f} µm is narrower than the focusing circle (radius "
        f"{radius_um:.3g} µm), so the focusing efficiency misses light; use --window-px {enough_px}"
    ]


@lru_cache(maxsize=8)
def strip_rings(layout: LayoutSettings, halo_px: int, rings: int) -> Tensor:
    """Return the number of the ring to which each pixel of a strip along a radius belongs.

    The strip consists of two central rows of pixels, from ring 0 to the edge of the aperture, and of a halo
    on all sides. Pixels beyond the last of the ``rings`` are assigned to the last ring.
    """
    along = torch.arange(-halo_px, layout.size_px // 2 + halo_px, dtype=torch.float64) + 0.5
    across = torch.arange(-halo_px - 1, halo_px + 1, dtype=torch.float64) + 0.5
    ring = (torch.hypot(across[:, None], along[None, :]) / layout.ring_px).floor().long()
    return ring.clamp(max=rings - 1)


def check_lens(settings: LensSettings, *, radial: bool) -> None:
    """Check that a lens with these settings can be designed. If ``radial`` is True, also check that the
    search can run along a radius.

    Raises:
        InputError: a search along a radius cannot represent the layout, the aperture or the light; the
            propagation is the far field; or the outermost zone of a focusing lens is narrower than two cells.
    """
    if radial and (settings.layout.symmetry != "radial" or settings.view.aperture != "circle"):
        raise InputError(
            "search path 'radial'",
            got=f"symmetry {settings.layout.symmetry!r}, aperture {settings.view.aperture!r}",
            wanted="a ring layout behind a circular aperture",
        )
    optics = settings.optics
    if radial and (optics.incidence_x or optics.incidence_y or optics.beam_um):
        got, wanted = "oblique incidence or a beam", "uniform light along the axis"
        hint = "use --set view.path=plane, without --large"
        raise InputError("search path 'radial'", got=got, wanted=wanted, hint=hint)
    if optics.propagation == "far-field":
        raise InputError(
            "propagation of a lens", got="far-field", wanted="auto, because a lens has its own focal plane"
        )
    if radial and settings.layout.size_px % 2:
        raise InputError("size_px for the radial path", got=settings.layout.size_px, wanted="an even number")
    if settings.task == "direct":
        _check_outermost_zone(settings)


def _check_outermost_zone(settings: LensSettings) -> None:
    """Check that the outermost zone of the lens is at least two cells wide. The width of this zone is the
    wavelength divided by the sum of two sines: the sine of the ray from the farthest point of the rim to the
    image, and the sine of the oblique light. On one side of the rim, the two sines have the same sign, so
    they are added.
    """
    layout, optics = settings.layout, settings.optics
    radius_um = layout.size_um / 2 * (math.sqrt(2) if settings.view.aperture == "square" else 1)
    oblique = math.hypot(optics.incidence_x, optics.incidence_y)
    zone_um = optics.wavelength_um / (optics.edge_sine(radius_um) + oblique)
    if zone_um < 2 * layout.cell_um:
        sine = optics.wavelength_um / (2 * layout.cell_um) - oblique
        farther = ""
        # No distance helps if the oblique light alone is too steep. The advised distance is rounded up.
        if sine > 0:
            needed_um = math.ceil(10 * radius_um * math.sqrt(1 / sine**2 - 1)) / 10
            farther = f"--distance-um {needed_um:.1f} or more, or "
        raise InputError(
            f"cells of {layout.cell_um:g} µm",
            got=f"an outermost zone of the lens {zone_um:.3g} µm wide",
            wanted="at least two cells per zone",
            hint=f"use {farther}smaller cells",
        )
