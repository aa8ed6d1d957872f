"""Gaussian blur that is differentiable in its width: separable, normalised, cut at four sigma.

Each axis is a product with a banded matrix, in blocks where the field is wide. For fields up to a few
thousand pixels this is faster than a Fourier transform, and no period or padding rule leaks in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from litho_data.foundation.errors import InputError

SUPPORT_SIGMAS = 4.0
# A narrower Gaussian has no weight left on the next pixel (exp(-50)); it also keeps 1/sigma finite.
_SMALLEST_SIGMA_PX = 0.1
# Most of a band's matrix is zeros; wider fields are cut into blocks, which for narrow ones is no faster.
_DENSE_PX = 768
_SMALLEST_BLOCK_PX = 64
# Wider than any field that is printed; a wider one would take the memory of a machine.
_LARGEST_RADIUS_PX = 4096

Edge = Literal["replicate", "zero"]
# How far a kernel reaches: four sigma, or three times the whole pixels of one (the authors' code).
Support = Literal["four-sigma", "three-whole-sigma"]


def gaussian_blur(
    field: Tensor,
    sigma_um: float | Tensor | tuple[float | Tensor, float | Tensor],
    pitch_um: float,
    *,
    edge: Edge = "replicate",
    radius_px: int | None = None,
) -> Tensor:
    """Blur ``field`` (..., y, x) to the same size with a Gaussian of standard deviation ``sigma_um``.

    g(d) ∝ exp(-d²/2σ²), normalised over its support of at least 4σ on each side.

    Args:
        field: floating-point tensor (..., y, x).
        sigma_um: standard deviation, µm; a pair (along y, along x) blurs anisotropically. Tensors
            carry gradients.
        pitch_um: sampling of the field, µm.
        edge: ``replicate`` continues the outermost pixels, ``zero`` adds nothing outside.
        radius_px: of the kernel on each side; four sigma by default.

    Raises:
        InputError: a pitch that is not positive.
    """
    if not pitch_um > 0:
        raise InputError("pitch_um", got=pitch_um, wanted="a positive number")
    along_y, along_x = sigma_um if isinstance(sigma_um, tuple) else (sigma_um, sigma_um)
    sigmas = [
        torch.as_tensor(sigma, dtype=field.dtype, device=field.device) / pitch_um
        for sigma in (along_y, along_x)
    ]
    radii = [kernel_radius_px(float(sigma.detach())) if radius_px is None else radius_px for sigma in sigmas]
    if edge == "replicate" and not _is_wide(field.shape, radii):
        return _blur(field, sigmas, radii, _continuing_band)
    padded = pad_field(field, radii[0], radii[1], edge)
    return blur_interior(padded, (sigmas[0], sigmas[1]), (radii[0], radii[1]))


def blur_interior(
    field: Tensor, sigma_px: Tensor | tuple[Tensor, Tensor], radius_px: int | tuple[int, int]
) -> Tensor:
    """Blur and keep only the pixels whose whole support lies inside: (..., y - 2r, x - 2r)."""
    sigmas = sigma_px if isinstance(sigma_px, tuple) else (sigma_px, sigma_px)
    radii = radius_px if isinstance(radius_px, tuple) else (radius_px, radius_px)
    return _blur(field, sigmas, radii, _band)


def _blur(
    field: Tensor,
    sigmas: Sequence[Tensor],
    radii: Sequence[int],
    band: Callable[[int, int, Tensor], Tensor],
) -> Tensor:
    """Blur by one matrix for each axis, made by ``band``; the interior of a wide field by blocks."""
    # Heights need full precision: bfloat16 resolves only some nanometres at 1 µm.
    with torch.autocast(device_type=field.device.type, enabled=False):
        field = field.float() if field.dtype in (torch.bfloat16, torch.float16) else field
        along_y, along_x = (sigma.to(field.dtype) for sigma in sigmas)
        if _is_wide(field.shape, radii):
            return _blur_blocks_y(_blur_blocks_x(field, radii[1], along_x), radii[0], along_y)
        rows = band(field.shape[-2], radii[0], along_y)
        columns = band(field.shape[-1], radii[1], along_x)
        return rows @ field @ columns.T


def _is_wide(shape: Sequence[int], radii: Sequence[int]) -> bool:
    """Whether blocks are faster than one matrix for each axis."""
    return min(shape[-2:]) > max(_DENSE_PX, 4 * max(radii))


def kernel_radius_px(sigma_px: float) -> int:
    """Whole pixels on each side that hold ``SUPPORT_SIGMAS`` standard deviations; 1 at least.

    Raises:
        InputError: a Gaussian wider than any field, or without a width.
    """
    if not SUPPORT_SIGMAS * sigma_px <= _LARGEST_RADIUS_PX:
        raise InputError(
            "Gaussian blur",
            got=f"a standard deviation of {sigma_px:g} px",
            wanted=f"at most {_LARGEST_RADIUS_PX / SUPPORT_SIGMAS:g} px",
        )
    return max(1, math.ceil(SUPPORT_SIGMAS * sigma_px))


def supported_radius_px(sigma_px: float, support: Support, cap_px: int | None) -> int:
    """Radius of a kernel by the rule of a model, at most ``cap_px`` where there is a cap."""
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


def _blur_blocks_x(field: Tensor, radius: int, sigma_px: Tensor) -> Tensor:
    left, right, count = _block_bands(field.shape[-1], radius, sigma_px)
    blocks = _in_blocks(field, -1, count, len(left))
    blurred = blocks[..., :-1, :] @ left.T + blocks[..., 1:, :] @ right.T
    return blurred.flatten(-2)[..., : field.shape[-1] - 2 * radius]


def _blur_blocks_y(field: Tensor, radius: int, sigma_px: Tensor) -> Tensor:
    upper, lower, count = _block_bands(field.shape[-2], radius, sigma_px)
    blocks = _in_blocks(field, -2, count, len(upper))
    blurred = upper @ blocks[..., :-1, :, :] + lower @ blocks[..., 1:, :, :]
    return blurred.flatten(-3, -2)[..., : field.shape[-2] - 2 * radius, :]


def _block_bands(size: int, radius: int, sigma_px: Tensor) -> tuple[Tensor, Tensor, int]:
    """What a block of the result takes of the same block of the field and of the next, and their number."""
    block = max(_SMALLEST_BLOCK_PX, 2 * radius)
    band = functional.pad(_band(block + 2 * radius, radius, sigma_px), (0, block - 2 * radius))
    return band[:, :block], band[:, block:], -(-(size - 2 * radius) // block)


def _in_blocks(field: Tensor, axis: int, count: int, block_px: int) -> Tensor:
    """One axis as (count + 1, block_px), filled with zeros, which reach no pixel of the interior."""
    missing = (count + 1) * block_px - field.shape[axis]
    padded = functional.pad(field, (0, missing) if axis == -1 else (0, 0, 0, missing))
    return padded.unflatten(axis, (count + 1, block_px))


def _band(size: int, radius: int, sigma_px: Tensor) -> Tensor:
    """Matrix (size - 2 radius, size) whose row i holds the kernel centred on column i + radius."""
    if size <= 2 * radius:
        raise InputError(
            "field to blur", got=f"{size} px", wanted=f"more than {2 * radius} px (twice the support)"
        )
    sigma = sigma_px.clamp(min=_SMALLEST_SIGMA_PX)
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, device=sigma.device) / sigma) ** 2)
    # All rows are windows on one symmetric kernel with zeros on both sides, the last row's first.
    kernel = functional.pad(taps / taps.sum(), (size - 2 * radius - 1,) * 2)
    return kernel.unfold(0, size, 1).flip(0)


def _continuing_band(size: int, radius: int, sigma_px: Tensor) -> Tensor:
    """Matrix (size, size) that blurs a line whose outermost pixels continue: they take the weight beyond."""
    band = _band(size + 2 * radius, radius, sigma_px)
    inner = band[:, radius:-radius].clone()
    inner[:, 0] += band[:, :radius].sum(1)
    inner[:, -1] += band[:, -radius:].sum(1)
    return inner
