"""Where a design starts: Gerchberg-Saxton phases for images, Fresnel phases for lenses."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from litho_data.foundation.grid import PixelGrid
from litho_design.optics import Optics, centred_grid
from litho_design.optimisation.parametrise import CellMap, nearest_levels


def gerchberg_saxton(
    propagator: Any,
    target: Tensor,
    cells: CellMap,
    *,
    iterations: int,
    weighted: bool,
    seed: int,
    level_phase: Tensor | None = None,
) -> tuple[Tensor, list[float]]:
    """A phase per cell whose propagated amplitude approaches sqrt(target).

    Each step replaces the propagated amplitude inside the output window, keeps the wave outside it,
    sends the correction back with the adjoint and projects on what the element can do: u' = Pi(u +
    P^H (a exp(j arg P u) - P u)). Because the norm of P is at most one, this majorises the squared
    amplitude error, which therefore never rises (Gerchberg and Saxton 1972). The weighted form
    (Di Leonardo et al. 2007, doi:10.1364/OE.15.001913) raises the wanted amplitude where light is
    missing; it trades that guarantee for uniformity.

    Args:
        propagator: RSPropagator or ASMPropagator on square grids of the element's pixel pitch.
        target: wanted intensity (size, size) in [0, 1].
        cells: the element's free cells.
        level_phase: printed phase of each level, radian (levels,); if given, the second half of the
            iterations projects on these phases instead of on the whole circle.

    Returns:
        Phase per cell, radian, and the amplitude error sqrt(sum (|P u| - a)^2) before each step.
    """
    generator = torch.Generator().manual_seed(seed)
    phase = (torch.rand(cells.cells, generator=generator) * 2 * math.pi).to(target)
    amplitude = target.clamp(min=0).sqrt()
    incident = math.sqrt(math.prod(propagator.source.shape) * math.prod(propagator.source.pitch_um))
    area = math.prod(propagator.target.pitch_um)
    amplitude = amplitude * (incident / math.sqrt(float(amplitude.square().sum()) * area))
    wanted, lit = amplitude.clone(), amplitude > 0
    errors = []
    for step in range(iterations):
        wave = cells(torch.polar(torch.ones_like(phase), phase))
        seen = propagator(wave)
        size = seen.abs()
        errors.append(float((size - amplitude).square().sum().sqrt()))
        if weighted:
            shortfall = (
                amplitude[lit] / size[lit].clamp(min=1e-12) * (size[lit].norm() / amplitude[lit].norm())
            )
            wanted[lit] *= shortfall.clamp(0.5, 2).sqrt()
            wanted *= amplitude.norm() / wanted.norm()
        missing = seen * (wanted / size.clamp(min=1e-12 * float(size.max())) - 1)
        mean_wave = cells.average(wave + propagator.adjoint(missing))
        phase = mean_wave.angle()
        if level_phase is not None and step >= iterations // 2:
            phase = level_phase[nearest_levels(phase, level_phase)]
    return phase, errors


def fresnel_lens_phase(cells: CellMap, layout_pitch_um: float, optics: Optics) -> Tensor:
    """The phase per cell of a perfect lens: phi = k (f - sqrt(f^2 + r^2)), radian.

    ``optics.distance_um`` is the focal length f.
    """
    grid: PixelGrid = centred_grid((cells.size_px, cells.size_px), layout_pitch_um)
    y, x = torch.from_numpy(grid.y_um)[:, None], torch.from_numpy(grid.x_um)[None, :]
    radius = (x**2 + y**2 + optics.distance_um**2).sqrt()
    phase = (2 * math.pi / optics.wavelength_um) * (optics.distance_um - radius)
    # Cells average the wave, not the phase: a mean over a wrapped phase means nothing.
    return cells.average(torch.polar(torch.ones_like(phase), phase)).angle().float()


def printed_phase(level_heights_um: list[float], optics: Optics) -> Tensor:
    """Phase of each printed level, radian (levels,)."""
    return torch.tensor(level_heights_um) * (2 * math.pi / optics.wave_height_um)
