"""Blur with a separable, normalised Gaussian, cut at four sigma and differentiable in its width.

Along each axis, blocks of pixels are multiplied by a band matrix of the kernel. For fields up to a few
thousand pixels, this is faster than a Fourier transform and needs no periodic padding.
"""

import math
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn import functional

from litho_data.foundation.errors import InputError

SUPPORT_SIGMAS = 4.0
# At this smallest sigma the weight of the next pixel is negligible (exp(-50)), and 1/sigma stays finite.
_SMALLEST_SIGMA_PX = 0.1
# Block sizes in pixels for kernels with a radius below 64 px, and for wider ones. Wider blocks multiply more
# zeros of the band matrix; products of narrower blocks are slower.
_BLOCK_PX, _WIDE_BLOCK_PX = 32, 64
# No printed field is wider than this radius, and a larger one would exhaust memory.
_LARGEST_RADIUS_PX = 4096

Edge = Literal["replicate", "zero"]
Sigma = float | Tensor | tuple[float | Tensor, float | Tensor]
# The radius of a kernel is four sigma or, as in the authors' code, three sigma rounded down to whole pixels.
Support = Literal["four-sigma", "three-whole-sigma"]


def gaussian_blur(
    field: Tensor,
    sigma_um: Sigma,
    pitch_um: float,
    *,
    edge: Edge | None = "replicate",
    radius_px: int | tuple[int, int] | None = None,
) -> Tensor:
    """Blur ``field`` (..., y, x) with a Gaussian of standard deviation ``sigma_um``.

    The kernel g(d) ∝ exp(-d²/2σ²) is normalised over its support of at least 4σ on each side.

    Args:
        field: floating-point tensor (..., y, x).
        sigma_um: standard deviation, µm; a pair (along y, along x) blurs anisotropically. If it is a tensor,
            gradients flow to it.
        pitch_um: sampling of the field, µm.
        edge: ``replicate`` repeats the outermost pixels, and ``zero`` assumes zeros outside; the size stays
            the same. None keeps only the pixels whose whole support lies inside, (..., y - 2r, x - 2r).
        radius_px: radius r of the kernel, or a pair (along y, along x); four sigma by default.

    Raises:
        InputError: a pitch that is not positive, or a field without pixels or narrower than the support.
    """
    if not pitch_um > 0:
        raise InputError("pitch_um", got=pitch_um, wanted="a positive number")
    if not field.numel():
        raise InputError("field to blur", got=f"shape {tuple(field.shape)}", wanted="one pixel or more")
    widths = sigma_um if isinstance(sigma_um, tuple) else (sigma_um, sigma_um)
    radii = radius_px if isinstance(radius_px, tuple) else (radius_px, radius_px)
    # Heights need full precision: bfloat16 resolves only some nanometres at 1 µm.
    with torch.autocast(device_type=field.device.type, enabled=False):
        field = field.float() if field.dtype in (torch.bfloat16, torch.float16) else field
        # Along x, then along y.
        for axis in (-1, -2):
            sigma_px = torch.as_tensor(widths[axis], dtype=field.dtype, device=field.device) / pitch_um
            radius = radii[axis]
            if radius is None:
                radius = kernel_radius_px(float(sigma_px.detach()))
            if edge is not None:
                field = pad_field(field, *((radius, 0) if axis == -2 else (0, radius)), edge)
            *samples, rows, columns = field.shape
            if field.shape[axis] <= 2 * radius:
                wanted = f"more than {2 * radius} px (twice the radius of the kernel)"
                raise InputError("field to blur", got=f"{field.shape[axis]} px", wanted=wanted)
            # Along x, all lines of all samples form one image.
            images = field.reshape(1, -1, columns) if axis == -1 else field.reshape(-1, rows, columns)
            blurred = _Blur.apply(images, _band(radius, sigma_px), axis)
            field = blurred.reshape(*samples, *((rows, -1) if axis == -1 else (-1, columns)))
        return field


def kernel_radius_px(sigma_px: float) -> int:
    """Return the radius, in whole pixels, of a kernel that extends to ``SUPPORT_SIGMAS`` standard deviations;
    at least 1.

    Raises:
        InputError: a Gaussian that is wider than any field, or whose width is not a number.
    """
    if not SUPPORT_SIGMAS * sigma_px <= _LARGEST_RADIUS_PX:
        raise InputError(
            "Gaussian blur",
            got=f"a standard deviation of {sigma_px:g} px",
            wanted=f"at most {_LARGEST_RADIUS_PX / SUPPORT_SIGMAS:g} px",
        )
    return max(1, math.ceil(SUPPORT_SIGMAS * sigma_px))


def supported_radius_px(sigma_px: float, support: Support, cap_px: int | None) -> int:
    """Return the radius of a kernel according to a model's rule ``support``, limited to ``cap_px`` if
    given.
    """
    radius = kernel_radius_px(sigma_px) if support == "four-sigma" else 3 * int(sigma_px)
    return radius if cap_px is None else min(radius, cap_px)


def pad_field(field: Tensor, rows_px: int, columns_px: int, edge: Edge = "replicate") -> Tensor:
    """Add a border to a (batch, channel, y, x) or (..., y, x) tensor."""
    border = (columns_px, columns_px, rows_px, rows_px)
    flat = field.reshape(-1, 1, *field.shape[-2:])
    if edge == "replicate":
        padded = functional.pad(flat, border, mode="replicate")
    else:
        padded = functional.pad(flat, border)
    return padded.reshape(*field.shape[:-2], *padded.shape[-2:])


class _Blur(torch.autograd.Function):
    """Blur samples (s, y, x) along one axis (-1 or -2) with the band of a symmetric kernel. The result is
    linear in samples and band.

    PyTorch's own backward pass through overlapping windows takes three times as long.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(samples: Tensor, band: Tensor, axis: int) -> Tensor:
        size = samples.shape[axis] - band.shape[1] + band.shape[0]
        found = []
        for windows in _windows(samples, band, axis):
            # (blocks, y, pixels of a block), or (blocks, pixels of a block, x).
            blocks = (windows @ band.mT).movedim(0, 1) if axis == -1 else band @ windows.mT
            line = (samples.shape[-2], -1) if axis == -1 else (-1, samples.shape[-1])
            found.append(blocks.reshape(line).narrow(axis, 0, size))
        return torch.stack(found)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, int], output: Tensor) -> None:
        samples, band, ctx.axis = inputs
        ctx.set_materialize_grads(False)
        # The field is kept only if the width is learned.
        ctx.save_for_backward(band, samples if ctx.needs_input_grad[1] else None)
        ctx.save_for_forward(band, samples)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor | None) -> tuple[Tensor | None, Tensor | None, None]:
        if gradient is None:
            return None, None, None
        band, samples = ctx.saved_tensors
        axis, of_samples, of_band = ctx.axis, None, None
        if ctx.needs_input_grad[0]:
            # The kernel is symmetric, so the backward pass is the same blur of the zero-padded gradient.
            reach = band.shape[1] - band.shape[0]
            of_samples = _Blur.apply(_pad_axis(gradient, reach, reach, axis), band, axis)
        if samples is not None:
            pairs = zip(
                _windows(gradient, band[:, : len(band)], axis), _windows(samples, band, axis), strict=True
            )
            of_band = torch.stack([(blocks.mT @ windows).sum(0) for blocks, windows in pairs]).sum(0)
        return of_samples, of_band, None

    @staticmethod
    def jvp(ctx: Any, samples_change: Tensor | None, band_change: Tensor | None, _: None) -> Tensor:
        band, samples = ctx.saved_tensors
        changes = [] if samples_change is None else [_Blur.apply(samples_change, band, ctx.axis)]
        changes += [] if band_change is None else [_Blur.apply(samples, band_change, ctx.axis)]
        return sum(changes[1:], changes[0])


def _windows(samples: Tensor, band: Tensor, axis: int) -> tuple[Tensor, ...]:
    """Yield for each sample the overlapping windows of its blocks, as views: (blocks, other axis, window).

    Samples are treated one at a time, because one product over several samples would copy the windows.
    """
    block, window = band.shape
    count = -(-(samples.shape[axis] - window + block) // block)
    whole = _pad_axis(samples, 0, (count - 1) * block + window - samples.shape[axis], axis)
    return whole.unfold(axis, window, block).movedim(axis - 1, -3).unbind()


def _pad_axis(field: Tensor, before: int, after: int, axis: int) -> Tensor:
    border = (before, after) if axis == -1 else (0, 0, before, after)
    return functional.pad(field, border) if before or after else field


def _band(radius: int, sigma_px: Tensor) -> Tensor:
    """Return the matrix (block, block + 2 radius) whose row i holds the kernel centred on column i +
    radius.
    """
    sigma = sigma_px.clamp(min=_SMALLEST_SIGMA_PX)
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, device=sigma.device) / sigma) ** 2)
    # Each row is a window on the zero-padded kernel, starting with the last row.
    block = _BLOCK_PX if radius < _WIDE_BLOCK_PX else _WIDE_BLOCK_PX
    kernel = functional.pad(taps / taps.sum(), (block - 1,) * 2)
    return kernel.unfold(0, block + 2 * radius, 1).flip(0)
