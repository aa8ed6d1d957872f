"""Rayleigh-Sommerfeld propagation: the exact discrete convolution between two planes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid
from litho_design.optics.convolution import convolve
from litho_design.optics.sampling import check_distance, fast_length, first_centre_um

_LARGEST_PHASES = 16
_LARGEST_MATRIX = 1 << 25


class RSPropagator(nn.Module):
    """Carry a complex field from one plane to a parallel one (first Rayleigh-Sommerfeld integral).

    U(p) = sum over source pixels q of u(q) h(p - q) dy dx, with
    h = z / (2 pi r^2) (1/r - j k) exp(j k r), r^2 = x^2 + y^2 + z^2, k = 2 pi / wavelength
    (time convention in which exp(+j k r) runs outwards; Goodman, Fourier Optics, ch. 3).
    The sum is exact for every pair of grids: the kernel is centred and spans all separations. Where
    the two pitches stand in a ratio of small integers it is evaluated by FFT (one convolution per
    pair of interleaved sub-grids), otherwise as a dense matrix.

    Args:
        source, target: grids of the two planes, origin and pitch in µm.
        distance_um: separation of the planes, µm.
        wavelength_um: wavelength in the medium, µm.
        dtype: torch.complex64 or torch.complex128; kernels are computed in double precision.

    Raises:
        InputError: distance below the sampling limit, or a dense matrix too large to store.
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
        check_distance(distance_um, source, target, wavelength_um)
        self.source, self.target = source, target
        axes = [_interleave(source, target, axis) for axis in range(2)]
        self._axes = [axis for axis in axes if axis is not None]
        if len(self._axes) == 2:
            self._padded = tuple(axis.padding for axis in self._axes)
            self._blocks = (self._axes[0].out_count, self._axes[1].out_count)
            kernel = _kernel_stack(self._axes, distance_um, wavelength_um, source, dtype)
        else:
            kernel = _dense_matrix(source, target, distance_um, wavelength_um, dtype)
        # Not persistent: it follows from the arguments, and a checkpoint must not carry it.
        self.register_buffer("transfer", kernel, persistent=False)

    def forward(self, field: Tensor) -> Tensor:
        """Propagate complex ``field`` (..., ny, nx) to (..., my, mx)."""
        if len(self._axes) < 2:
            flat = field.flatten(-2) @ self.transfer.T
            return flat.unflatten(-1, self.target.shape)
        vertical, horizontal = self._axes
        phases = _split(field, vertical, horizontal)
        result = convolve(phases, self.transfer, self._blocks)
        return _join(result, vertical, horizontal, self.target.shape)

    def adjoint(self, field: Tensor) -> Tensor:
        """P^H of ``forward``: complex (..., my, mx) to (..., ny, nx); it sends a field back."""
        if len(self._axes) < 2:
            flat = field.flatten(-2) @ self.transfer.conj()
            return flat.unflatten(-1, self.source.shape)
        vertical, horizontal = self._axes
        phases = _split(field, vertical.reversed(), horizontal.reversed())
        transfer = self.transfer.transpose(0, 1).conj()
        result = convolve(phases, transfer, (vertical.in_count, horizontal.in_count))
        return _join(result, vertical.reversed(), horizontal.reversed(), self.source.shape)


@dataclass(frozen=True)
class _Axis:
    """How one axis of both grids falls apart into sub-grids of one common, coarser pitch."""

    in_phases: int
    out_phases: int
    in_size: int
    out_size: int
    start_um: float
    in_pitch_um: float
    out_pitch_um: float

    @property
    def in_count(self) -> int:
        return -(-self.in_size // self.in_phases)

    @property
    def out_count(self) -> int:
        return -(-self.out_size // self.out_phases)

    @property
    def length(self) -> int:
        return fast_length(self.in_count + self.out_count - 1)

    @property
    def padding(self) -> int:
        return self.in_count * self.in_phases - self.in_size

    def reversed(self) -> _Axis:
        return _Axis(
            self.out_phases, self.in_phases, self.out_size, self.in_size,
            -self.start_um, self.out_pitch_um, self.in_pitch_um,
        )  # fmt: skip

    def separations_um(self, out_phase: int, in_phase: int) -> Tensor:
        """Separations of one pair of sub-grids in wrapped order; unused places repeat a used one."""
        step = self.in_pitch_um * self.in_phases
        index = torch.arange(self.length, dtype=torch.float64)
        index = torch.where(index < self.out_count, index, index - self.length)
        index = index.clamp(min=-(self.in_count - 1))
        offset = self.start_um + out_phase * self.out_pitch_um - in_phase * self.in_pitch_um
        return offset + index * step


def _interleave(source: PixelGrid, target: PixelGrid, axis: int) -> _Axis | None:
    ratio = target.pitch_um[axis] / source.pitch_um[axis]
    fraction = Fraction(ratio).limit_denominator(_LARGEST_PHASES)
    if fraction.numerator > _LARGEST_PHASES or abs(fraction / Fraction(ratio) - 1) > 1e-12:
        return None
    return _Axis(
        in_phases=fraction.numerator,
        out_phases=fraction.denominator,
        in_size=source.shape[axis],
        out_size=target.shape[axis],
        start_um=first_centre_um(target, axis) - first_centre_um(source, axis),
        in_pitch_um=source.pitch_um[axis],
        out_pitch_um=target.pitch_um[axis],
    )


def _kernel_stack(
    axes: list[_Axis], distance_um: float, wavelength_um: float, source: PixelGrid, dtype: torch.dtype
) -> Tensor:
    vertical, horizontal = axes
    area = math.prod(source.pitch_um)
    rows = []
    for out_y in range(vertical.out_phases):
        for out_x in range(horizontal.out_phases):
            row = []
            for in_y in range(vertical.in_phases):
                for in_x in range(horizontal.in_phases):
                    y = vertical.separations_um(out_y, in_y)[:, None]
                    x = horizontal.separations_um(out_x, in_x)[None, :]
                    kernel = rs_kernel(y, x, distance_um, wavelength_um) * area
                    row.append(torch.fft.fft2(kernel).to(dtype))
            rows.append(torch.stack(row))
    return torch.stack(rows)


def rs_kernel(y_um: Tensor, x_um: Tensor, distance_um: float, wavelength_um: float) -> Tensor:
    """h(x, y) of the first Rayleigh-Sommerfeld integral, 1/µm^2, complex128 on broadcast separations."""
    wavenumber = 2 * math.pi / wavelength_um
    squared = y_um.double() ** 2 + x_um.double() ** 2 + distance_um**2
    radius = squared.sqrt()
    factor = torch.complex(1 / radius, torch.full_like(radius, -wavenumber))
    factor *= distance_um / (2 * math.pi * squared)
    return factor * torch.polar(torch.ones_like(radius), wavenumber * radius)


def _dense_matrix(
    source: PixelGrid, target: PixelGrid, distance_um: float, wavelength_um: float, dtype: torch.dtype
) -> Tensor:
    entries = math.prod(source.shape) * math.prod(target.shape)
    if entries > _LARGEST_MATRIX:
        raise InputError(
            "pitch of the output grid",
            got=f"{target.pitch_um} µm for a source pitch of {source.pitch_um} µm",
            wanted=f"a ratio of integers up to {_LARGEST_PHASES} on grids this large",
            hint="choose a commensurate output pitch or smaller grids",
        )
    out_y, out_x = (torch.from_numpy(axis) for axis in (target.y_um, target.x_um))
    in_y, in_x = (torch.from_numpy(axis) for axis in (source.y_um, source.x_um))
    y = out_y[:, None, None, None] - in_y[None, None, :, None]
    x = out_x[None, :, None, None] - in_x[None, None, None, :]
    kernel = rs_kernel(y, x, distance_um, wavelength_um) * math.prod(source.pitch_um)
    return kernel.reshape(math.prod(target.shape), math.prod(source.shape)).to(dtype)


def _split(field: Tensor, vertical: _Axis, horizontal: _Axis) -> Tensor:
    """(..., ny, nx) to (..., phases, ny / phases, nx / phases), zero-padded to whole blocks."""
    padded = F.pad(field, (0, horizontal.padding, 0, vertical.padding))
    blocks = padded.unflatten(-1, (horizontal.in_count, horizontal.in_phases))
    blocks = blocks.unflatten(-3, (vertical.in_count, vertical.in_phases))
    return blocks.permute(*range(blocks.dim() - 4), -3, -1, -4, -2).flatten(-4, -3)


def _join(phases: Tensor, vertical: _Axis, horizontal: _Axis, shape: tuple[int, int]) -> Tensor:
    """The inverse of ``_split`` on the output side."""
    blocks = phases.unflatten(-3, (vertical.out_phases, horizontal.out_phases))
    lead = range(blocks.dim() - 4)
    field = blocks.permute(*lead, -2, -4, -1, -3).flatten(-4, -3).flatten(-2, -1)
    return field[..., : shape[0], : shape[1]]
