"""Propagate a wave to a parallel plane by a Fourier transform that several processes share.

Each process transforms its own rows. Then the processes exchange data, so that each process has whole
columns. It transforms them, multiplies them by the transfer function and transforms them back. A second
exchange restores the rows. The method is the transposed form of the two-dimensional transform (Takahashi,
Fast Fourier Transform Algorithms for Parallel Computers, ch. 8).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_design.large.bands import Bands
from litho_design.optics import ASMPropagator, Optics, centred_grid
from litho_design.optics.angular_spectrum import spectrum_axes, transfer_function
from litho_design.optics.propagators import takes_spectrum
from litho_design.optics.rayleigh_sommerfeld import rs_kernel
from litho_design.optics.sampling import check_distance, fast_length
from litho_design.printers.source import Device

_COLUMNS = 256


class BandedPropagator:
    """A propagator between equal grids for a field whose rows are divided among several processes. It gives
    the same result as the propagator from ``make_propagator``, up to rounding.

    The field and the result contain only the rows of this process, as complex64 of shape (rows, size). The
    kernel is even along both axes, so only half of each column of its Fourier transform is stored.

    Args:
        pitch_um: side of a pixel, µm.
        optics: wavelength, distance and kind of propagation.
        bands: bands of the element.

    Raises:
        InputError: the far field is requested, or the Rayleigh-Sommerfeld propagator is requested although
            its kernel is aliased at this distance.
    """

    def __init__(self, pitch_um: float, optics: Optics, bands: Bands, device: Device = "cpu"):
        if optics.propagation == "far-field":
            wanted = "auto, because only the near field is computed in bands"
            raise InputError("propagation of a large element", got="far-field", wanted=wanted)
        size = bands.size_px
        self.bands, self.device = bands, device
        self.source = self.target = centred_grid((size, size), pitch_um)
        self.length = fast_length(2 * size - 1)
        width = min(_COLUMNS, bands.band_px)
        blocks = range(0, self.length, width)
        self._starts = [
            blocks[one] if one < len(blocks) else self.length
            for one in (bands.ranks.share(len(blocks), rank).start for rank in range(bands.ranks.count))
        ] + [self.length]
        first, last = self._starts[bands.ranks.rank : bands.ranks.rank + 2]
        self._blocks = [slice(at - first, min(at + width, last) - first) for at in range(first, last, width)]
        self._transfer = self._room(last - first, self.length // 2 + 1)
        spectrum = takes_spectrum(self.source, self.target, optics)
        (self._spectrum_transfer if spectrum else self._kernel_transfer)(optics)

    def __call__(self, field: Tensor) -> Tensor:
        """Propagate the field; gradients flow back through the adjoint."""
        carried: Tensor = _Carry.apply(field, self)
        return carried

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply P^H, the adjoint of the propagation, to a field."""
        return self.carried(field, conjugate=True)

    def carried(self, field: Tensor, *, conjugate: bool = False) -> Tensor:
        """Propagate the rows of this process forward or by the adjoint, without recording gradients."""
        size, carried = self.bands.size_px, torch.empty_like(field)
        columns = self._to_columns(lambda band: field[band])
        for block in self._blocks:
            wave = torch.fft.fft(columns[:, block].T.contiguous(), n=self.length)
            half, rest = self._transfer[block], self.length - self.length // 2 - 1
            # The kernel is even, so its transform repeats in reverse order above the middle frequency.
            mirrored = half[:, 1 : rest + 1].flip(1)
            wave[:, : half.shape[1]] *= half.conj() if conjugate else half
            wave[:, half.shape[1] :] *= mirrored.conj() if conjugate else mirrored
            columns[:, block] = torch.fft.ifft(wave)[:, :size].T
        rows = self._to_rows(columns)
        for band in self.bands.own():
            carried[band] = torch.fft.ifft(rows[band])[:, :size]
        return carried

    def _to_columns(self, given: Callable[[slice], Tensor]) -> Tensor:
        """Transform the rows of this process band by band, exchange them with the other processes, and return
        the whole columns that belong to this process, shape (size, columns).
        """
        bands, ranks = self.bands, self.bands.ranks
        rows = self._room(len(bands.rows()), self.length)
        for band in bands.own():
            rows[band] = torch.fft.fft(given(band), n=self.length)
        if ranks.count == 1:
            return rows
        width = self._width(ranks.rank)
        parts = [rows[:, self._starts[rank] : self._starts[rank + 1]] for rank in range(ranks.count)]
        got = ranks.exchange(parts, [len(bands.rows(rank)) * width for rank in range(ranks.count)])
        return got.reshape(bands.size_px, width)

    def _to_rows(self, columns: Tensor) -> Tensor:
        """Exchange the columns of this process, shape (size, columns), with the other processes, and return
        the rows of this process, shape (rows, length).
        """
        bands, ranks = self.bands, self.bands.ranks
        if ranks.count == 1:
            return columns
        parts = [columns[rows.start : rows.stop] for rows in map(bands.rows, range(ranks.count))]
        widths = [self._width(rank) for rank in range(ranks.count)]
        own = len(bands.rows())
        sizes = [own * width for width in widths]
        got = ranks.exchange(parts, sizes).split(sizes)
        return torch.cat([part.reshape(own, width) for part, width in zip(got, widths, strict=True)], 1)

    def _room(self, *shape: int) -> Tensor:
        return torch.empty(shape, dtype=torch.complex64, device=self.device)

    def _width(self, rank: int) -> int:
        return self._starts[rank + 1] - self._starts[rank]

    def _kernel_transfer(self, optics: Optics) -> None:
        """Compute the transform of the Rayleigh-Sommerfeld kernel in double precision, first along rows, then
        along columns.
        """
        pitch, size = self.source.pitch_um[0], self.bands.size_px
        check_distance(optics.distance_um, self.source, self.target, optics.wavelength_um)
        # Separations between source and target pixels, in pixels, in the order that an FFT needs. Unused
        # entries repeat the largest separation.
        index = torch.arange(self.length)
        wrapped = torch.minimum(index, self.length - index).clamp(max=size - 1)
        away_um, below_um = wrapped.double() * pitch, torch.arange(size).double() * pitch
        start = self.bands.rows().start

        def row(band: slice) -> Tensor:
            y = below_um[start + band.start : start + band.stop, None]
            return rs_kernel(y, away_um[None], optics.distance_um, optics.wavelength_um) * pitch**2

        columns = self._to_columns(row)
        for block in self._blocks:
            line = columns[:, block].T.to(torch.complex128)[:, wrapped]
            self._transfer[block] = torch.fft.fft(line)[:, : self.length // 2 + 1].to(torch.complex64)

    def _spectrum_transfer(self, optics: Optics) -> None:
        """Compute the transfer function of free space. If the element is small, the Fourier transform of this
        propagator is too short, and steep rays would wrap around. The kernel of ``ASMPropagator``, which has
        a longer period, is then used instead.
        """
        given = (self.source, self.target, optics.distance_um, optics.wavelength_um)
        first, last = self._starts[self.bands.ranks.rank : self.bands.ranks.rank + 2]
        rows, columns = spectrum_axes(*given)
        half = self.length // 2 + 1
        if len(rows.frequency) > self.length:
            self._transfer[:] = ASMPropagator(*given).transfer[:half, first:last].T
            return
        for block in self._blocks:
            own = columns.part(slice(first + block.start, first + block.stop))
            found = transfer_function(
                rows.part(slice(0, half)), own, optics.distance_um, optics.wavelength_um
            )
            self._transfer[block] = found.T.to(torch.complex64)


class _Carry(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, field: Tensor, propagator: BandedPropagator) -> Tensor:
        ctx.propagator = propagator
        return propagator.carried(field)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.propagator.adjoint(gradient), None
