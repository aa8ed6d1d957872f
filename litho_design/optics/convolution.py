"""A linear convolution by FFT that computes only the samples that are kept, forwards and backwards."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def convolve(field: Tensor, transfer: Tensor, out_shape: tuple[int, int]) -> Tensor:
    """Convolve with a kernel given by its transform, and keep the first ``out_shape`` samples.

    Args:
        field: complex (..., phases_in, ny, nx).
        transfer: complex (phases_out, phases_in, ky, kx), FFT of the kernel stored in wrapped order
            (sample 0 first, negative separations at the end); ky >= ny + my - 1, kx alike.
        out_shape: (my, mx).

    Returns:
        complex (..., phases_out, my, mx).
    """
    return _Convolution.apply(field, transfer, out_shape)


class _Convolution(torch.autograd.Function):
    """The adjoint is the same operation with the conjugate transfer and the two shapes exchanged.

    Written out because autograd would keep padded copies and transform the rows that are cropped.
    """

    @staticmethod
    def forward(ctx: Any, field: Tensor, transfer: Tensor, out_shape: tuple[int, int]) -> Tensor:
        ctx.save_for_backward(transfer)
        ctx.in_shape = (int(field.shape[-2]), int(field.shape[-1]))
        return _apply(field, transfer, out_shape)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (transfer,) = ctx.saved_tensors
        return convolve(gradient, transfer.transpose(0, 1).conj(), ctx.in_shape), None, None


def _apply(field: Tensor, transfer: Tensor, out_shape: tuple[int, int]) -> Tensor:
    ky, kx = transfer.shape[-2:]
    spectrum = torch.fft.fft(torch.fft.fft(field, n=kx, dim=-1), n=ky, dim=-2)
    if transfer.shape[0] == transfer.shape[1] == 1:
        spectrum = spectrum.mul_(transfer[0])
    else:
        spectrum = (transfer * spectrum.unsqueeze(-4)).sum(-3)
    rows = torch.fft.ifft(spectrum, dim=-2)[..., : out_shape[0], :]
    return torch.fft.ifft(rows, dim=-1)[..., : out_shape[1]].contiguous()
