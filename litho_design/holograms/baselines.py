"""Compute baselines for a hologram: the scores of a black image and of ideal elements on the same grid."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor

from litho_data.foundation.hashes import array_sha256
from litho_design.holograms.bench import HologramBench, camera_ssim, hologram_score
from litho_design.holograms.loss import counted_pixels, hologram_loss
from litho_design.holograms.settings import HologramSettings
from litho_design.images.similarity import likeness, si_psnr_db
from litho_design.optics import element_field, intensity_share
from litho_design.optimisation.descent import descended
from litho_design.optimisation.parameters import CellMap
from litho_design.optimisation.phases import gerchberg_saxton

_ITERATIONS = 40
_PHASE_ITERATIONS = 100
_PHASE_RATE = 0.3
# Names of the scores that are defined for any image.
_OF_IMAGES = ("si_psnr_db", "ssim", "si_psnr_resolved_db", "ssim_resolved", "ssim_camera")
# Cache of the baselines. They do not depend on the printer, so all arms of a comparison share them.
_KEPT: dict[tuple[object, ...], dict[str, dict[str, float]]] = {}


def hologram_baselines(
    bench: HologramBench, cells: CellMap, target: Tensor, settings: HologramSettings
) -> dict[str, dict[str, float]]:
    """Return the scores of a black image and of ideal elements in the optics of ``bench``, keyed by the name
    of the baseline.

    ``diffraction-limited`` is an element whose amplitude and phase may take any values on each pixel. Its
    wave is found by forty Gerchberg-Saxton steps, which start from an image with a flat phase. ``continuous
    phase`` has one arbitrary phase per cell, without a printer and levels. These phases are found by a
    hundred descent steps on the loss of the design, which start from the result of the Gerchberg-Saxton
    algorithm. The lowest loss of these steps is one of the scores of ``continuous phase``. ``weighted GS``
    also has one phase per cell, found by forty weighted Gerchberg-Saxton steps.
    """
    parts = settings.layout, settings.optics, settings.loss
    pixels = array_sha256(target.cpu().numpy(), "1", ("y", "x"))
    asked = *(one.model_dump_json() for one in parts), settings.search.seed, pixels, str(target.device)
    if asked not in _KEPT:
        _KEPT[asked] = _baselines(bench, cells, target, settings)
    return copy.deepcopy(_KEPT[asked])


def _baselines(
    bench: HologramBench, cells: CellMap, target: Tensor, settings: HologramSettings
) -> dict[str, dict[str, float]]:
    wave_um = settings.optics.wave_height_um
    counted = counted_pixels(target, settings.loss, settings.layout.pitch_um)
    found = {"black image": _of_black(bench, target, settings)}
    limited = _free_amplitude(bench, target)
    score = hologram_score([(1.0, bench.propagator(limited))], limited, target, bench.grid, settings.optics)
    found["diffraction-limited"] = {name: getattr(score, name) for name in _OF_IMAGES}
    best, loss = _continuous_phase(bench, cells, target, settings, counted)
    weighted, _ = gerchberg_saxton(
        bench.propagator, target, cells, bench.illumination(), iterations=_ITERATIONS, weighted=True,
        seed=settings.search.seed,
    )  # fmt: skip
    for name, phase in (("continuous phase", best), ("weighted GS", weighted)):
        height_um = cells(phase) * (wave_um / (2 * math.pi))
        found[name] = bench.score(height_um, target).model_dump()
        if counted is not None:
            seen = bench(height_um)[counted].double()
            found[name]["si_psnr_window_db"] = si_psnr_db(seen, target[counted].double())
    found["continuous phase"]["loss"] = loss
    return found


@torch.no_grad()
def best_signal_efficiency(bench: HologramBench, height_um: Tensor, target: Tensor) -> float:
    """Starting from the phases of a print, search for the phases of an element that sends the most power to
    the signal. Return the share of the incident power that then reaches the signal.

    The signal is the set of pixels whose target exceeds 0.5. Each step is u <- exp(j arg P^H S P u), where u
    is the wave behind the element, P is the propagator and S is the mask of the signal. Every pixel has its
    own phase. The operator P^H S P is positive semidefinite, so no step reduces the power, and the result is
    never below the share that the print itself reaches.
    """
    signal = target > 0.5
    wave = element_field(height_um, bench.grid, bench.optics)
    size = wave.abs()
    for _ in range(_ITERATIONS):
        back = bench.propagator.adjoint(bench.propagator(wave) * signal)
        wave = torch.polar(size, back.angle())
    return float(intensity_share(bench.propagator(wave), bench.grid)[signal].double().sum())


def _of_black(bench: HologramBench, target: Tensor, settings: HologramSettings) -> dict[str, float]:
    black, wanted = torch.zeros_like(target).double(), target.double()
    figures = likeness(black, wanted, bench.resolved(wanted))
    dark = [(1.0, black.to(torch.complex128))]
    return figures | {"ssim_camera": camera_ssim(dark, wanted, bench.grid, settings.optics)}


@torch.no_grad()
def _free_amplitude(bench: HologramBench, target: Tensor) -> Tensor:
    """Return a wave of unit power whose image has approximately the amplitude sqrt(target). The search for
    this wave starts from an image with a flat phase. The wave has shape (size, size).
    """
    wanted = target.sqrt()
    area = math.prod(bench.grid.pitch_um)
    wave = bench.propagator.adjoint(wanted.to(torch.complex64))
    for _ in range(_ITERATIONS):
        seen = bench.propagator(wave)
        size = seen.abs()
        scale = size.square().sum() / (wanted * size).sum()
        wave = wave + bench.propagator.adjoint(torch.polar(wanted * scale, seen.angle()) - seen)
    return wave / (wave.abs().square().sum() * area).sqrt()


def _continuous_phase(
    bench: HologramBench, cells: CellMap, target: Tensor, settings: HologramSettings, counted: Tensor | None
) -> tuple[Tensor, float]:
    """Search for the phases of the cells that minimise the loss of the design. Return these phases, in
    radians, and their loss.
    """
    phase, _ = gerchberg_saxton(
        bench.propagator, target, cells, bench.illumination(), iterations=_ITERATIONS, weighted=False,
        seed=settings.search.seed, counted=counted,
    )  # fmt: skip
    free = phase.clone().requires_grad_()

    def loss() -> tuple[Tensor, Tensor]:
        seen = bench(cells(free) * (settings.optics.wave_height_um / (2 * math.pi)))
        return hologram_loss(seen, target, settings.loss, counted)[0], free.detach().clone()

    return descended([free], loss, rate=_PHASE_RATE, iterations=_PHASE_ITERATIONS)
