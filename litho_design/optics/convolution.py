"""Convolve by FFT. Rows that are cropped afterwards are not transformed, neither in the convolution nor in
its gradient.

On a CPU, columns are transformed a block at a time, so that the values of a block stay in the cache of the
processor from the transform to its inverse. For fields of 1024 px, this halves the time.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from litho_data.foundation.grid import PixelGrid
from litho_design.optics.sampling import fast_length

# Number of values in a block of columns: 1 MiB in complex64, half of a common second-level cache.
_BLOCK_VALUES = 1 << 17


class KernelPropagator(nn.Module):
    """Propagate a field from one plane to another by convolution with a kernel.

    The grid of the kernel may be finer than the grids of the source and the target, by integer factors.

    Args:
        kernel: values of the kernel at the separations that ``wrapped_order`` returns, a complex128 array of
            shape (ky, kx).
        finer: number of kernel pixels per source pixel, and number of kernel pixels per target pixel. Each is
            a pair (along y, along x).
        dtype: torch.complex64 or torch.complex128.
    """

    transfer: Tensor

    def __init__(
        self,
        source: PixelGrid,
        target: PixelGrid,
        kernel: Tensor,
        dtype: torch.dtype,
        finer: tuple[tuple[int, int], tuple[int, int]] = ((1, 1), (1, 1)),
    ):
        super().__init__()
        self.source, self.target, self._finer = source, target, finer
        # The buffer is not persistent: it can be computed from the arguments, so checkpoints need not contain
        # it.
        self.register_buffer("transfer", torch.fft.fft2(kernel).to(dtype), persistent=False)

    def forward(self, field: Tensor) -> Tensor:
        """Propagate a complex field of shape (..., ny, nx); the result has shape (..., my, mx)."""
        here, there = self._finer
        found = convolve(_spread(field, here), self.transfer, fine_shape(self.target.shape, there))
        return found[..., :: there[0], :: there[1]]

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply P^H, the adjoint of ``forward``, to a complex field of shape (..., my, mx). The result has
        shape (..., ny, nx).
        """
        here, there = self._finer
        found = convolve(_spread(field, there), self.transfer.conj(), fine_shape(self.source.shape, here))
        return found[..., :: here[0], :: here[1]]


def fine_shape(shape: tuple[int, ...], finer: tuple[int, int]) -> tuple[int, int]:
    """Return the shape of a finer grid whose first and last pixel centres coincide with those of a grid of
    shape ``shape``. ``finer`` is the number of fine pixels per coarse pixel along y and x.
    """
    rows, columns = ((count - 1) * times + 1 for count, times in zip(shape, finer, strict=True))
    return rows, columns


def wrapped_order(here: int, there: int) -> Tensor:
    """Return all separations, in pixels, between ``here`` source pixels and ``there`` target pixels along one
    axis. They are in the order that an FFT needs.

    Negative separations come last. If the FFT has more entries than there are separations, the surplus
    entries repeat the lowest separation.
    """
    length = fast_length(here + there - 1)
    index = torch.arange(length)
    return torch.where(index < there, index, index - length).clamp(min=1 - here)


def convolve(field: Tensor, transfer: Tensor, out_shape: tuple[int, int]) -> Tensor:
    """Convolve a field with a kernel that is given by its transform. Return the first ``out_shape`` samples
    of the result.

    Args:
        field: complex tensor of shape (..., ny, nx).
        transfer: FFT of the kernel in the order of ``wrapped_order``, complex, shape (ky, kx), where ky >= ny
            + my - 1, and likewise for kx.
        out_shape: shape (my, mx) of the result.

    Returns:
        A complex tensor of shape (..., my, mx).
    """
    return _Convolution.apply(field, transfer, out_shape)


class _Convolution(torch.autograd.Function):
    """A convolution and its gradient. The gradient is computed by the adjoint, which is a convolution with
    the conjugate transfer function. The gradient is implemented explicitly, because autograd would keep
    padded copies of the field and would also transform rows that are cropped afterwards.
    """

    @staticmethod
    def forward(ctx: Any, field: Tensor, transfer: Tensor, out_shape: tuple[int, int]) -> Tensor:
        ctx.save_for_backward(transfer)
        ctx.in_shape = (int(field.shape[-2]), int(field.shape[-1]))
        ky, kx = transfer.shape
        rows = torch.fft.fft(field, n=kx, dim=-1)
        found = rows.new_empty(*rows.shape[:-2], out_shape[0], kx)
        width = max(1, _BLOCK_VALUES // ky) if field.device.type == "cpu" else kx
        for first in range(0, kx, width):
            block = slice(first, first + width)
            columns = rows[..., block].transpose(-1, -2).contiguous()
            spectrum = torch.fft.fft(columns, n=ky).mul_(transfer[:, block].T)
            found[..., block] = torch.fft.ifft(spectrum)[..., : out_shape[0]].transpose(-1, -2)
        return torch.fft.ifft(found)[..., : out_shape[1]].contiguous()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (transfer,) = ctx.saved_tensors
        return convolve(gradient, transfer.conj(), ctx.in_shape), None, None


def _spread(field: Tensor, finer: tuple[int, int]) -> Tensor:
    """Place the samples of a field on a finer grid, with zeros between them."""
    if finer == (1, 1):
        return field
    fine = field.new_zeros(*field.shape[:-2], *fine_shape(field.shape[-2:], finer))
    fine[..., :: finer[0], :: finer[1]] = field
    return fine
