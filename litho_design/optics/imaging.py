"""Incoherent image formation: convolution of an object with an intensity point spread function."""

from __future__ import annotations

import torch
from torch import Tensor

from litho_design.optics.sampling import fast_length


class Blur:
    """x -> psf * x on the object's frame, dark outside it; linear, without wrap-around.

    The PSF has odd sides and its middle sample is the origin, so that nothing shifts.

    Args:
        psf: real (k, k), any energy; its gradient is kept.
        frame: (ny, nx) of the object and of the recorded image.
    """

    def __init__(self, psf: Tensor, frame: tuple[int, int]):
        rows, columns = psf.shape
        assert rows % 2 == columns % 2 == 1, "a PSF of odd sides has a middle sample"
        self._frame = frame
        self._size = [fast_length(n + k - 1) for n, k in zip(frame, (rows, columns), strict=True)]
        middle_first = torch.nn.functional.pad(psf, (0, self._size[1] - columns, 0, self._size[0] - rows))
        self._transfer = torch.fft.rfft2(middle_first.roll((-(rows // 2), -(columns // 2)), (0, 1)))

    def forward(self, image: Tensor) -> Tensor:
        """psf * image, (..., ny, nx)."""
        return self._filter(image, self._transfer)

    def transpose(self, image: Tensor) -> Tensor:
        """The transposed operator (correlation with the PSF), (..., ny, nx)."""
        return self._filter(image, self._transfer.conj())

    def _filter(self, image: Tensor, transfer: Tensor) -> Tensor:
        spectrum = torch.fft.rfft2(image, s=self._size) * transfer
        full = torch.fft.irfft2(spectrum, s=self._size)
        return full[..., : self._frame[0], : self._frame[1]]


def bin_pixels(image: Tensor, factor: int) -> Tensor:
    """Sum blocks of ``factor`` x ``factor`` pixels: power per coarse pixel, (..., ny / f, nx / f)."""
    blocks = image.unflatten(-1, (-1, factor)).unflatten(-3, (-1, factor))
    return blocks.sum((-3, -1))
