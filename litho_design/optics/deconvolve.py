"""Richardson-Lucy deconvolution, differentiable and correct for any energy of the PSF."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from litho_design.optics.imaging import Blur

_DARKEST = 1e-8
_STEPS_PER_CHECKPOINT = 10


def richardson_lucy(recorded: Tensor, psf: Tensor, *, iterations: int = 50) -> Tensor:
    """Estimate the object behind a recorded image.

    e <- e * H^T (b / H e) / (H^T 1), from a flat start of the right flux (Richardson 1972, Lucy
    1974). The division by H^T 1 makes it right at the borders and for a PSF of any energy: the
    estimate approaches the object itself, and sum(H e) = sum(b) after every step.

    Args:
        recorded: image (..., ny, nx); negative values (read noise) count as dark.
        psf: real (k, k) of odd sides, on the same pixels.

    Returns:
        Estimate (..., ny, nx); gradients flow to both arguments and are recomputed in blocks of
        steps, so that memory does not grow with ``iterations``.
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

    for done in range(0, iterations, _STEPS_PER_CHECKPOINT):
        count = min(_STEPS_PER_CHECKPOINT, iterations - done)
        if torch.is_grad_enabled():
            estimate = checkpoint(steps, estimate, count, use_reentrant=False)
        else:
            estimate = steps(estimate, count)
    return estimate
