"""Band-limited angular spectrum propagation, for distances too short for the sampled kernel."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid
from litho_design.optics.convolution import convolve
from litho_design.optics.sampling import fast_length, first_centre_um


class ASMPropagator(nn.Module):
    """Carry a complex field to a parallel plane with the transfer function of free space.

    H(f) = exp(j 2 pi z sqrt(1/wavelength^2 - f^2)); the root is complex, so evanescent waves decay
    instead of becoming NaN. Frequencies whose rays leave the padded window are removed, because
    they would come back wrapped (Matsushima and Shimobaba 2009, doi:10.1364/OE.17.019662). A
    negative distance runs the propagating waves backwards and drops the evanescent ones.

    Args:
        source, target: grids of equal pitch; shape and origin are free.
        distance_um: separation of the planes, µm; may be zero or negative.
        wavelength_um: wavelength in the medium, µm.
        dtype: torch.complex64 or torch.complex128.

    Raises:
        InputError: unequal pitches.
    """

    transfer: Tensor

    def __init__(
        self,
        source: PixelGrid,
        target: PixelGrid,
        distance_um: float,
        wavelength_um: float,
        *,
        dtype: torch.dtype = torch.complex64,
    ):
        super().__init__()
        if any(abs(a - b) > 1e-12 * a for a, b in zip(source.pitch_um, target.pitch_um, strict=True)):
            raise InputError(
                "output pitch of the angular spectrum method",
                got=f"{target.pitch_um} µm",
                wanted=f"the source's pitch {source.pitch_um} µm",
                hint="use RSPropagator for another pitch",
            )
        self.source, self.target = source, target
        vertical, horizontal = (
            _axis_band(source, target, axis, distance_um, wavelength_um) for axis in (0, 1)
        )
        fy, fx = vertical[0][:, None], horizontal[0][None, :]
        band = vertical[1][:, None] & horizontal[1][None, :]
        squared = torch.complex(wavelength_um**-2 - fy**2 - fx**2, torch.zeros(()).double())
        axial = squared.sqrt()
        if distance_um < 0:
            band = band & (axial.imag == 0)
        shift = 2 * math.pi * (fy * vertical[2] + fx * horizontal[2])
        transfer = torch.exp(2j * math.pi * distance_um * axial + 1j * shift) * band
        self.register_buffer("transfer", transfer.to(dtype)[None, None], persistent=False)

    def forward(self, field: Tensor) -> Tensor:
        """Propagate complex ``field`` (..., ny, nx) to (..., my, mx)."""
        return convolve(field.unsqueeze(-3), self.transfer, self.target.shape).squeeze(-3)

    def adjoint(self, field: Tensor) -> Tensor:
        """P^H of ``forward``: complex (..., my, mx) to (..., ny, nx)."""
        return convolve(field.unsqueeze(-3), self.transfer.conj(), self.source.shape).squeeze(-3)


def _axis_band(
    source: PixelGrid, target: PixelGrid, axis: int, distance_um: float, wavelength_um: float
) -> tuple[Tensor, Tensor, float]:
    """Frequencies (cycles/µm), those whose lateral shift stays inside the window, and the grid shift, µm."""
    pitch = source.pitch_um[axis]
    length = fast_length(source.shape[axis] + target.shape[axis] - 1)
    frequency = torch.fft.fftfreq(length, pitch, dtype=torch.float64)
    start = first_centre_um(target, axis) - first_centre_um(source, axis)
    middle = start + (target.shape[axis] - source.shape[axis]) * pitch / 2
    cosine = (1 - (wavelength_um * frequency) ** 2).clamp(min=0).sqrt()
    ray_shift = distance_um * wavelength_um * frequency
    inside = (ray_shift - middle * cosine).abs() <= length * pitch / 2 * cosine
    # At zero distance nothing moves, evanescent waves included.
    return frequency, inside | (distance_um == 0), start
