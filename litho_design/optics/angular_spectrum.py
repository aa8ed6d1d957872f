"""Propagate waves with the band-limited angular spectrum method. It is used at distances that are too short
for the sampled Rayleigh-Sommerfeld kernel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid
from litho_design.optics.convolution import KernelPropagator, wrapped_order
from litho_design.optics.sampling import fast_length, first_centre_um, largest_separation_um

# Longest period, in pixels, with which the propagated field may repeat along each axis. Computing a kernel of
# this size takes half a gibibyte of memory.
_LONGEST_PERIOD = 4096


class ASMPropagator(KernelPropagator):
    """Propagate a complex field to a parallel plane by means of the transfer function of free space.

    The transfer function is H(f) = exp(j 2 pi z sqrt(1/wavelength^2 - f^2)). For evanescent waves the root is
    imaginary, so these waves decay. Because H is sampled, the propagated field is periodic. The period is
    extended until the steepest rays do not wrap around, but beyond 4096 pixels only as far as the grids need.
    Frequencies whose rays would still wrap around are removed (after Matsushima and Shimobaba 2009,
    doi:10.1364/OE.17.019662). A longer period slows down the construction of the propagator but not the
    propagation, because the kernel is stored only at the separations that occur between the two grids. If the
    distance is negative, waves are propagated backwards and evanescent waves are dropped.

    Pixels larger than half a wavelength represent rays only up to a certain angle, and for these rays the
    result is exact. Smaller pixels also represent rays close to grazing. Of the wave behind a rough element,
    1 % is then missing or wrapped around, so ``RSPropagator`` is the better choice.

    Args:
        source, target: grids of the two planes. Their pitches must be equal, but their shapes and origins may
            differ.
        distance_um: separation of the planes, µm; may be zero or negative.
        wavelength_um: wavelength in the medium, µm.
        dtype: torch.complex64 or torch.complex128.

    Raises:
        InputError: the pitches are unequal.
    """

    def __init__(
        self,
        source: PixelGrid,
        target: PixelGrid,
        distance_um: float,
        wavelength_um: float,
        *,
        dtype: torch.dtype = torch.complex64,
    ):
        if any(abs(a - b) > 1e-12 * a for a, b in zip(source.pitch_um, target.pitch_um, strict=True)):
            raise InputError(
                "output pitch of the angular spectrum method",
                got=f"{target.pitch_um} µm",
                wanted=f"the source's pitch {source.pitch_um} µm",
                hint="use RSPropagator for another pitch",
            )
        y, x = spectrum_axes(source, target, distance_um, wavelength_um)
        kernel = torch.fft.ifft(transfer_function(y, x, distance_um, wavelength_um))[:, x.kept]
        super().__init__(source, target, torch.fft.ifft(kernel, dim=0)[y.kept], dtype)


@dataclass(frozen=True)
class SpectrumAxis:
    """One axis of the spectrum of a wave between two grids.

    ``frequency`` contains the frequencies in cycles/µm. ``inside`` is False at the frequencies that are
    removed because their rays would wrap around. ``kept`` contains the indices of the kernel samples that are
    stored, and ``start_um`` is the shift from the source grid to the target grid.
    """

    frequency: Tensor
    inside: Tensor
    kept: Tensor
    start_um: float

    def part(self, which: slice) -> SpectrumAxis:
        """Return this axis with only those frequencies that the slice ``which`` selects."""
        return replace(self, frequency=self.frequency[which], inside=self.inside[which])


def spectrum_axes(
    source: PixelGrid, target: PixelGrid, distance_um: float, wavelength_um: float
) -> tuple[SpectrumAxis, SpectrumAxis]:
    """Return the y axis and the x axis of the spectrum of a wave between two grids."""
    y, x = (_axis_band(source, target, axis, distance_um, wavelength_um) for axis in (0, 1))
    return y, x


def transfer_function(y: SpectrumAxis, x: SpectrumAxis, distance_um: float, wavelength_um: float) -> Tensor:
    """Return the transfer function of free space, complex128 of shape (y, x). It is 0 at frequencies whose
    rays would wrap around.
    """
    # Most frequencies occur with both signs, and ``wave`` does not depend on the sign.
    (fy, row), (fx, column) = (torch.unique(axis.frequency.abs(), return_inverse=True) for axis in (y, x))
    squared = wavelength_um**-2 - fy[:, None] ** 2 - fx[None, :] ** 2
    wave = torch.exp(2j * math.pi * distance_um * torch.complex(squared, torch.zeros(()).double()).sqrt())
    if distance_um < 0:
        # If evanescent waves were propagated backwards, they would grow until they overflow.
        wave = torch.where(squared >= 0, wave, 0)
    along_y, along_x = (
        torch.exp(2j * math.pi * axis.start_um * axis.frequency) * axis.inside for axis in (y, x)
    )
    return wave[row[:, None], column[None, :]].mul_(along_y[:, None]).mul_(along_x[None, :])


def _axis_band(
    source: PixelGrid, target: PixelGrid, axis: int, distance_um: float, wavelength_um: float
) -> SpectrumAxis:
    pitch, there, here = source.pitch_um[axis], target.shape[axis], source.shape[axis]
    index = wrapped_order(here, there)
    sine = min(wavelength_um / (2 * pitch), 1 - 1e-6)
    reach_um = abs(distance_um) * sine / math.sqrt(1 - sine**2)
    wanted = math.ceil((reach_um + largest_separation_um(source, target, axis)) / pitch) + 1
    length = fast_length(max(len(index), min(wanted, _LONGEST_PERIOD)))
    frequency = torch.fft.fftfreq(length, pitch, dtype=torch.float64)
    start = first_centre_um(target, axis) - first_centre_um(source, axis)
    middle = start + (there - here) * pitch / 2
    cosine = (1 - (wavelength_um * frequency) ** 2).clamp(min=0).sqrt()
    ray_shift = distance_um * wavelength_um * frequency
    # A ray wraps around if it reaches a periodic copy of the target. A ray reaches no copy if its sideways
    # shift differs from ``middle`` by no more than this distance.
    furthest_um = (length - (here + there) / 2) * pitch
    inside = (ray_shift - middle * cosine).abs() <= furthest_um * cosine
    # At zero distance, all frequencies are kept, because propagation changes nothing.
    return SpectrumAxis(frequency, inside | (distance_um == 0), index % length, start)
