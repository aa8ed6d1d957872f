"""Incoherent imaging: blur an object with an intensity point spread function, and deconvolve the image."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from litho_design.optics.sampling import fast_length

_DARKEST = 1e-8
# In the backward pass, the Richardson-Lucy steps are recomputed in blocks of this many steps. If the values
# of all steps (about twenty per pixel and step) fit into the memory stated below, they are kept and not
# recomputed.
_STEPS_PER_CHECKPOINT = 10
_KEPT_VALUES, _MOST_KEPT_BYTES = 20, 2**28


class Blur:
    """The convolution of an object with a PSF. The object and its image have the same pixels, which form the
    frame. The object is dark outside the frame. The convolution does not wrap around.

    The number of pixels along each side of the PSF is odd. The middle pixel is the origin, so an image is not
    shifted relative to its object.

    Args:
        psf: real PSF of shape (k, k). Its sum need not be 1. Gradients flow to the PSF.
        frame: shape (ny, nx) of the object and of the recorded image.
    """

    def __init__(self, psf: Tensor, frame: tuple[int, int]):
        rows, columns = psf.shape
        assert rows % 2 == columns % 2 == 1, "a PSF of odd sides has a middle sample"
        self._frame = frame
        # Pixel i receives from pixel j the PSF at i - j and, wrapped around, at i - j ± length. If the length
        # is at least the frame plus half a PSF, the wrapped samples lie outside the PSF. The array must also
        # be large enough to hold the PSF. The length is even, because a real transform of odd length takes
        # nearly twice as long.
        lengths = (max(n + k // 2, k) for n, k in zip(frame, (rows, columns), strict=True))
        self._size = [2 * fast_length(-(-length // 2)) for length in lengths]
        middle_first = torch.nn.functional.pad(psf, (0, self._size[1] - columns, 0, self._size[0] - rows))
        self._transfer = torch.fft.rfft2(middle_first.roll((-(rows // 2), -(columns // 2)), (0, 1)))

    def forward(self, image: Tensor) -> Tensor:
        """Return the convolution of an image with the PSF; both have shape (..., ny, nx)."""
        return self._filter(image, self._transfer)

    def transpose(self, image: Tensor) -> Tensor:
        """Apply the transposed operator, which is the correlation with the PSF, to an image of shape
        (..., ny, nx).
        """
        return self._filter(image, self._transfer.conj())

    def _filter(self, image: Tensor, transfer: Tensor) -> Tensor:
        spectrum = torch.fft.rfft2(image, s=self._size) * transfer
        full = torch.fft.irfft2(spectrum, s=self._size)
        return full[..., : self._frame[0], : self._frame[1]]


def bin_pixels(image: Tensor, factor: int) -> Tensor:
    """Return the sums over blocks of ``factor`` x ``factor`` pixels. The result has shape
    (..., ny / factor, nx / factor).
    """
    blocks = image.unflatten(-1, (-1, factor)).unflatten(-3, (-1, factor))
    return blocks.sum((-3, -1))


def richardson_lucy(recorded: Tensor, psf: Tensor, iterations: int = 50) -> Tensor:
    """Estimate the object behind a recorded image.

    Each step replaces the estimate e by e * H^T (b / H e) / (H^T 1), where b is the recorded image and H is
    the blur by the PSF. The first estimate is flat and has the total light of the image (Richardson 1972,
    Lucy 1974). The division by H^T 1 makes the result correct at the borders and for a PSF whose sum is not
    1. After every step, sum(H e) = sum(b).

    Args:
        recorded: recorded image, shape (..., ny, nx). Read noise may make some values negative; they are
            treated as dark.
        psf: real PSF on the same pixels, shape (k, k) with odd k.

    Returns:
        The estimate, shape (..., ny, nx). Gradients flow to the recorded image and to the PSF. For large
        images, the backward pass recomputes the steps block by block, so memory does not grow with
        ``iterations``.
    """
    blur = Blur(psf, (int(recorded.shape[-2]), int(recorded.shape[-1])))
    seen = recorded.clamp(min=_DARKEST)
    weight = blur.transpose(torch.ones_like(recorded)).clamp(min=_DARKEST)
    flux = seen.sum((-2, -1), keepdim=True) / weight.sum((-2, -1), keepdim=True)
    estimate = flux.expand_as(seen)

    def steps(current: Tensor, count: int) -> Tensor:
        for _ in range(count):
            ratio = seen / blur.forward(current).clamp(min=_DARKEST)
            current = current * blur.transpose(ratio).clamp(min=0) / weight
        return current

    kept_bytes = iterations * recorded.numel() * _KEPT_VALUES * recorded.element_size()
    if not torch.is_grad_enabled() or kept_bytes < _MOST_KEPT_BYTES:
        return steps(estimate, iterations)
    for done in range(0, iterations, _STEPS_PER_CHECKPOINT):
        count = min(_STEPS_PER_CHECKPOINT, iterations - done)
        estimate = checkpoint(steps, estimate, count, use_reentrant=False)
    return estimate
