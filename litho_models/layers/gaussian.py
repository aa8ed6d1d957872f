"""A blur by a normalised Gaussian. The kernel is separable and ends at four standard deviations, and the blur
is differentiable in the width of the kernel.

Along each axis, blocks of pixels are multiplied by a band matrix that contains the kernel. For fields up to a
few thousand pixels wide, these products are faster than a Fourier transform, and they need no periodic
padding.
"""

import math
from functools import lru_cache
from typing import Any, Literal

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.nn import functional

from litho_data.foundation.errors import InputError

SUPPORT_SIGMAS = 4.0
# Smaller standard deviations are replaced by this value. The weight of the next pixel is then negligible
# (exp(-50)), and 1/sigma stays finite.
_SMALLEST_SIGMA_PX = 0.1
# Sizes of the blocks in pixels: the first for kernels with a radius below _WIDE_BLOCK_PX, the second for
# wider kernels. With wider blocks, more zeros of the band matrix are multiplied; with narrower blocks, the
# matrix products are slower.
_BLOCK_PX, _WIDE_BLOCK_PX = 32, 64
# Largest radius of a kernel. No printed field is wider, and a larger radius would exhaust the memory.
_LARGEST_RADIUS_PX = 4096

Edge = Literal["replicate", "zero"]
Sigma = float | Tensor | tuple[float | Tensor, float | Tensor]
# Rule for the radius of a kernel: either four sigma, rounded up to whole pixels, or three times the whole
# number of pixels in sigma. The code of the paper's authors uses the second rule.
Support = Literal["four-sigma", "three-whole-sigma"]


def gaussian_blur(
    field: Tensor,
    sigma_um: Sigma,
    pitch_um: float,
    *,
    edge: Edge | None = "replicate",
    radius_px: int | tuple[int, int] | None = None,
) -> Tensor:
    """Blur a field with a Gaussian of standard deviation ``sigma_um``. The field has shape (..., ny, nx).

    The kernel is proportional to exp(-d²/2σ²), where d is the distance. Its sum over all pixels within the
    radius is 1.

    Args:
        field: floating-point tensor of shape (..., ny, nx).
        sigma_um: standard deviation, µm, or a pair of standard deviations (along y, along x). If it is a
            tensor, gradients flow to it.
        pitch_um: pixel pitch of the field, µm.
        edge: how the field is padded beyond its edge: ``replicate`` repeats the outermost pixels, and
            ``zero`` adds zeros. In both cases, the result has the shape of the field. With None, the field is
            not padded. The result then contains only the pixels that are at least the radius r from the edge,
            with shape (..., ny - 2r, nx - 2r).
        radius_px: radius r of the kernel in pixels, or a pair of radii (along y, along x); by default four
            standard deviations, rounded up.

    Raises:
        InputError: the pitch is not positive, the kernel is too wide, the field has no pixels, or the field
            is narrower than the kernel.
    """
    if not pitch_um > 0:
        raise InputError("pitch_um", got=pitch_um, wanted="a positive number")
    if not field.numel():
        raise InputError("field to blur", got=f"shape {tuple(field.shape)}", wanted="one pixel or more")
    widths = sigma_um if isinstance(sigma_um, tuple) else (sigma_um, sigma_um)
    radii = radius_px if isinstance(radius_px, tuple) else (radius_px, radius_px)
    # Heights need the precision of float32. At 1 µm, bfloat16 resolves only some nanometres.
    with torch.autocast(device_type=field.device.type, enabled=False):
        field = field.float() if field.dtype in (torch.bfloat16, torch.float16) else field
        # Blur along x, then along y.
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
            # For the blur along x, the lines of all samples are stacked into one image.
            images = field.reshape(1, -1, columns) if axis == -1 else field.reshape(-1, rows, columns)
            if _differentiated(field, sigma_px):
                blurred = _Blur.apply(images, _band(radius, sigma_px), axis)
            else:
                # Without derivatives, the band matrix is cached. In a small field, keeping track of
                # derivatives would take twice as long as the blur itself.
                band = _known_band(radius, float(sigma_px), sigma_px.dtype, sigma_px.device)
                blurred = _Blur.forward(images, band, axis)
            field = blurred.reshape(*samples, *((rows, -1) if axis == -1 else (-1, columns)))
        return field


def kernel_radius_px(sigma_px: float) -> int:
    """Return the radius of a kernel that extends to ``SUPPORT_SIGMAS`` standard deviations, rounded up to
    whole pixels. The result is at least 1.

    Raises:
        InputError: the Gaussian is wider than any field, or its width is not a number.
    """
    if not SUPPORT_SIGMAS * sigma_px <= _LARGEST_RADIUS_PX:
        raise InputError(
            "Gaussian blur",
            got=f"a standard deviation of {sigma_px:g} px",
            wanted=f"at most {_LARGEST_RADIUS_PX / SUPPORT_SIGMAS:g} px",
        )
    return max(1, math.ceil(SUPPORT_SIGMAS * sigma_px))


def supported_radius_px(sigma_px: float, support: Support, cap_px: int | None) -> int:
    """Return the radius of a kernel in whole pixels according to the rule ``support``. If ``cap_px`` is
    given, the radius is at most ``cap_px``.
    """
    radius = kernel_radius_px(sigma_px) if support == "four-sigma" else 3 * int(sigma_px)
    return radius if cap_px is None else min(radius, cap_px)


def pad_field(field: Tensor, rows_px: int, columns_px: int, edge: Edge = "replicate") -> Tensor:
    """Add a border of ``rows_px`` pixels above and below and of ``columns_px`` pixels left and right of a
    field of shape (..., ny, nx). The border repeats the outermost pixels or contains zeros.
    """
    border = (columns_px, columns_px, rows_px, rows_px)
    flat = field.reshape(-1, 1, *field.shape[-2:])
    if edge == "replicate":
        padded = functional.pad(flat, border, mode="replicate")
    else:
        padded = functional.pad(flat, border)
    return padded.reshape(*field.shape[:-2], *padded.shape[-2:])


class _Blur(torch.autograd.Function):
    """Blur samples of shape (samples, ny, nx) along one axis (-1 or -2) with the band matrix of a symmetric
    kernel. The result is linear in the samples and in the band matrix.

    The class defines its own derivatives. They take a third of the time of PyTorch's backward pass through
    overlapping windows.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(samples: Tensor, band: Tensor, axis: int) -> Tensor:
        size = samples.shape[axis] - band.shape[1] + band.shape[0]
        found = []
        for windows in _windows(samples, band, axis):
            # The shape is (blocks, ny, pixels of a block) along x, and (blocks, pixels of a block, nx) along
            # y.
            blocks = (windows @ band.mT).movedim(0, 1) if axis == -1 else band @ windows.mT
            line = (samples.shape[-2], -1) if axis == -1 else (-1, samples.shape[-1])
            found.append(blocks.reshape(line).narrow(axis, 0, size))
        return torch.stack(found)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, int], output: Tensor) -> None:
        samples, band, ctx.axis = inputs
        ctx.set_materialize_grads(False)
        # The backward pass needs the field only if the width of the kernel is learned. Otherwise the field is
        # not kept.
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
    """Divide each sample into blocks along the axis, and return the window of each block. A window is a block
    extended on both sides by the radius of the kernel, so neighbouring windows overlap. The function returns
    one tensor per sample, which is a view of shape (blocks, length of the other axis, window).

    The samples are kept apart, because a single matrix product over several samples would copy the windows.
    """
    block, window = band.shape
    count = -(-(samples.shape[axis] - window + block) // block)
    whole = _pad_axis(samples, 0, (count - 1) * block + window - samples.shape[axis], axis)
    return whole.unfold(axis, window, block).movedim(axis - 1, -3).unbind()


def _pad_axis(field: Tensor, before: int, after: int, axis: int) -> Tensor:
    border = (before, after) if axis == -1 else (0, 0, before, after)
    return functional.pad(field, border) if before or after else field


def _differentiated(*numbers: Tensor) -> bool:
    """Return True if PyTorch records operations on these numbers for derivatives, or if ``torch.func`` has
    wrapped one of them, so that it has no single value.
    """
    recorded = torch.is_grad_enabled() and any(one.requires_grad for one in numbers)
    forward_mode = torch.autograd.forward_ad._current_level >= 0
    return recorded or forward_mode or any(map(is_functorch_wrapped_tensor, numbers))


@lru_cache(maxsize=32)
def _known_band(radius: int, sigma_px: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    return _band(radius, torch.tensor(sigma_px, dtype=dtype, device=device))


def _band(radius: int, sigma_px: Tensor) -> Tensor:
    """Return the band matrix of a kernel. The matrix has shape (block, block + 2 radius). Row i contains the
    kernel, centred on column i + radius.
    """
    sigma = sigma_px.clamp(min=_SMALLEST_SIGMA_PX)
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, device=sigma.device) / sigma) ** 2)
    # Each row of the matrix is a window on the zero-padded kernel. ``unfold`` gives the windows in reverse
    # order, so their order is flipped.
    block = _BLOCK_PX if radius < _WIDE_BLOCK_PX else _WIDE_BLOCK_PX
    kernel = functional.pad(taps / taps.sum(), (block - 1,) * 2)
    return kernel.unfold(0, block + 2 * radius, 1).flip(0)
