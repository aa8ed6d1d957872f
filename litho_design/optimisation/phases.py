"""Find the phases that a design needs (Gerchberg-Saxton for images, Fresnel for lenses) and the printed
levels nearest to them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from litho_design.optics import Optics, centred_grid
from litho_design.optimisation.parameters import CellMap

# A wave is treated as having no phase if its amplitude is below this share of the amplitude behind the
# element.
_DARK = 1e-12
# The starting phases are drawn from a range of plus or minus this value, in radians. If phases were drawn
# from the whole circle, the phases of one in six pairs of neighbouring cells would finally differ by more
# than half a wave. Printing rounds off such a large step, and the search does not remove it. The narrower
# range reduces the number of large steps by a third, and different seeds still give different results.
_START_PHASE_RAD = 1.0


def gerchberg_saxton(
    propagator: Any,
    target: Tensor,
    cells: CellMap,
    illumination: Tensor,
    *,
    iterations: int,
    weighted: bool,
    seed: int,
    level_phase: Tensor | None = None,
    counted: Tensor | None = None,
    total: Callable[[Tensor], Tensor] | None = None,
) -> tuple[Tensor, list[float]]:
    """Find one phase per cell, such that the propagated amplitude approaches sqrt(target).

    Each step replaces the propagated amplitude inside the output window by the target amplitude and keeps the
    wave outside the window unchanged. The adjoint of the propagator carries this correction back to the
    element. The corrected wave is then projected onto the set of waves that an element with one phase per
    cell can produce in the given light: u' = Pi(u + P^H (a exp(j arg P u) - P u)). Here, u is the wave behind
    the element, P is the propagator, ``a`` is the target amplitude, and Pi is the projection. The norm of P
    is at most one, so each step minimises an upper bound of the squared amplitude error, and the error never
    rises (Gerchberg and Saxton 1972). The weighted form (Di Leonardo et al. 2007, doi:10.1364/OE.15.001913)
    raises the target amplitude where light is missing. With this form, the image is more uniform, but the
    error may rise. The initial phases are drawn at random within one radian of pi. If the levels span a full
    wave, pi is the middle of their range.

    Args:
        propagator: propagator with an adjoint, such as ``RSPropagator``, on square grids with the pixel pitch
            of the element.
        target: target intensity in [0, 1], shape (size, size).
        cells: map between the free cells of the element and its pixels.
        illumination: wave behind a flat element, shape (size, size), at any scale.
        counted: boolean mask, shape (size, size), of the pixels whose amplitude is prescribed. On other
            pixels, the wave is kept as it is. If a mask is given, the target amplitude is scaled to the light
            on the pixels of the mask.
        level_phase: printed phase of each level, in radians, shape (levels,). If given, only these phases are
            allowed in the projections of the second half of the iterations.
        total: function that sums values over the pixels of the whole element. It is needed only if ``cells``
            and ``target`` cover just a part of the element.

    Returns:
        The phase of each cell, in radians, and a list of the amplitude error sqrt(sum (|P u| - a)^2) before
        each step.
    """
    add = total or torch.sum

    def norm(values: Tensor) -> Tensor:
        return add(values.square()).sqrt()

    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(cells.of_all, generator=generator) * 2 - 1
    phase = cells.own(math.pi + _START_PHASE_RAD * drawn).to(target)
    amplitude = target.clamp(min=0).sqrt()
    incident = math.sqrt(math.prod(propagator.source.shape) * math.prod(propagator.source.pitch_um))
    area = math.prod(propagator.target.pitch_um)
    # The light is scaled to a mean square of 1. It is rounded after the scaling, so that a plane wave along
    # the axis is exactly 1.
    light = illumination.to(target.device, torch.complex128)
    light = light * (math.sqrt(math.prod(propagator.source.shape)) / norm(light.abs()))
    light = light.to(target.dtype.to_complex())
    amplitude = amplitude * (incident / math.sqrt(float(add(amplitude.square())) * area))
    wanted, lit = amplitude.clone(), amplitude > 0
    errors = []
    for step in range(iterations):
        wave = cells(torch.polar(torch.ones_like(phase), phase)) * light
        seen = propagator(wave)
        size = seen.abs()
        errors.append(float(norm(size - amplitude)))
        if weighted:
            shortfall = amplitude[lit] / size[lit].clamp(min=_DARK) * (norm(size[lit]) / norm(amplitude[lit]))
            wanted[lit] *= shortfall.clamp(0.5, 2).sqrt()
            wanted *= norm(amplitude) / norm(wanted)
        aim = wanted if counted is None else wanted * (norm(size[counted]) / norm(wanted))
        missing = seen * (aim / size.clamp(min=_DARK) - 1)
        missing = missing if counted is None else missing * counted
        mean_wave = cells.average(light.conj() * (wave + propagator.adjoint(missing)))
        phase = mean_wave.angle()
        if level_phase is not None and step >= iterations // 2:
            phase = level_phase[nearest_levels(phase, level_phase)]
    return phase, errors


def fresnel_lens_phase(cells: CellMap, pitch_um: float, optics: Optics) -> Tensor:
    """Return the phase of each cell of a perfect lens, in radians: phi = k (f - sqrt(f^2 + r^2) - s . p),
    where r is the distance from the axis, p the position and s the sines of the angles of incidence.

    ``optics.distance_um`` is the focal length f.
    """
    grid = centred_grid((cells.size_px, cells.size_px), pitch_um)
    y, x = torch.from_numpy(grid.y_um)[:, None], torch.from_numpy(grid.x_um)[None, :]
    radius = (x**2 + y**2 + optics.distance_um**2).sqrt()
    path_um = optics.distance_um - radius - optics.oblique_path_um(y, x)
    phase = (2 * math.pi / optics.wavelength_um) * path_um
    # For each cell, the mean of the complex wave is computed instead of the mean of the phase, because the
    # mean of wrapped phases is meaningless.
    return cells.average(torch.polar(torch.ones_like(phase), phase)).angle().float()


def focusing_levels(phase: Tensor, level_phase: Tensor) -> Tensor:
    """Add a constant to the phase of a lens, and return the levels whose printed phases are nearest to the
    sum. The constant is chosen such that the least light is lost.

    If the stroke is below one wave, the phases of the levels leave a gap on the phase circle. The constant
    determines which cells have phases in this gap. Of 24 constants, the one with the largest amplitude at the
    focus is used. This amplitude is the modulus of the mean of exp(j (printed phase - phase of the lens))
    over the cells.
    """
    best, best_value = nearest_levels(phase, level_phase), -math.inf
    for turn in torch.arange(0, 1, 1 / 24) * (2 * torch.pi):
        levels = nearest_levels(phase + turn, level_phase)
        value = float(torch.polar(torch.ones_like(phase), level_phase[levels] - phase).mean().abs())
        if value > best_value:
            best, best_value = levels, value
    return best


def printed_phase(level_heights_um: Sequence[float], optics: Optics) -> Tensor:
    """Return the phase of each printed level, in radians, shape (levels,)."""
    return torch.tensor(level_heights_um) * (2 * math.pi / optics.wave_height_um)


def nearest_levels(phase: Tensor, level_phase: Tensor) -> Tensor:
    """Return, for each phase (radians), the level whose printed phase is closest on the circle, as int64."""
    distance = phase.new_full(phase.shape, math.inf)
    nearest = torch.zeros(phase.shape, dtype=torch.long, device=phase.device)
    for level, printed in enumerate(level_phase.tolist()):
        off = torch.remainder(phase - printed + math.pi, 2 * math.pi).sub_(math.pi).abs_()
        closer = off < distance
        distance = torch.where(closer, off, distance)
        nearest = torch.where(closer, level, nearest)
    return nearest
