"""Linear filters, gradients and warps that effects use. At zero strength, each filter or warp returns exactly
its input (bit for bit).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn import functional

from litho_models.models.features import neighbours

# For slopes below this value, ``rounded_power`` is smoothed so that it stays differentiable.
_LEAST_SLOPE = 1e-3


def pixel_numbers(field: Tensor) -> tuple[Tensor, Tensor]:
    """Return the row numbers and the column numbers of the pixels, of shapes (ny, 1) and (1, nx)."""
    y, x = (torch.arange(n).to(field) for n in field.shape[-2:])
    return y[:, None], x[None]


def add_filtered(
    field: Tensor,
    transfer_minus_one: Callable[[Tensor, Tensor], Tensor],
    pitch_um: float,
    reach_um: float,
) -> Tensor:
    """Filter a field with a transfer function T. The field is filtered with T - 1, and the outcome is added
    to the field. If T = 1, the field is therefore returned unchanged (bit for bit).

    Args:
        field: tensor of shape (b, 1, ny, nx).
        transfer_minus_one: function of the frequencies fy and fx, in cycles/µm, that returns T - 1. The
            frequencies are those of the padded field and have shapes (rows, 1) and (1, columns/2 + 1).
        pitch_um: lateral sampling, µm.
        reach_um: half the support of the kernel, µm. As in the base models, the field is padded by this
            length on each side, with its edge values.
    """
    ny, nx = field.shape[-2:]
    pad = min(round(reach_um / pitch_um) + 1, ny - 1, nx - 1)
    size_y, size_x = (next_fast_len(n + 2 * pad, real=True) for n in (ny, nx))
    padding = (pad, size_x - nx - pad, pad, size_y - ny - pad)
    padded = functional.pad(field, padding, mode="replicate")
    fy = torch.fft.fftfreq(size_y, pitch_um, dtype=field.dtype, device=field.device)[:, None]
    fx = torch.fft.rfftfreq(size_x, pitch_um, dtype=field.dtype, device=field.device)[None, :]
    spectrum = torch.fft.rfft2(padded) * transfer_minus_one(fy, fx)
    change = torch.fft.irfft2(spectrum, s=(size_y, size_x))
    return field + change[..., pad : pad + ny, pad : pad + nx]


def add_blur(field: Tensor, variance_um2: Tensor | float, pitch_um: float, reach_um: float) -> Tensor:
    """Blur a field isotropically with a Gaussian of variance s² (µm²): T = exp(-2 π² s² f²)."""

    def transfer_minus_one(fy: Tensor, fx: Tensor) -> Tensor:
        along_y, along_x = (torch.expm1(-2 * math.pi**2 * variance_um2 * f * f) for f in (fy, fx))
        # With T = (1 + along_y) (1 + along_x), only one exponential per row and per column is needed.
        return along_y + along_x * (1 + along_y)

    return add_filtered(field, transfer_minus_one, pitch_um, reach_um)


def local_mean(field: Tensor, length: Tensor, pitch: float, reach: float = 3.0) -> Tensor:
    """Return the mean of a field around each pixel. The mean has Gaussian weights with standard deviation
    ``length``, and reaches to ``reach`` standard deviations. Length and pitch have the same unit.
    """
    return add_blur(field, length**2, pitch, reach * float(length.detach()))


def add_scattered(layout: Tensor, weight: Tensor, length: Tensor, pitch: float) -> Tensor:
    """Add the dose that leaks in from the neighbourhood of each pixel: D = (M + η G_b * M) / (1 + η), where η
    is the weight of this dose, G_b is a Gaussian of standard deviation b, and * is convolution. The length b
    and the pitch have the same unit.
    """
    return layout + weight / (1 + weight) * (local_mean(layout, length, pitch) - layout)


def trailing_response(frequency: Tensor, length_um: Tensor, pitch_um: float) -> Tensor:
    """Return the transfer function T of the recursive filter y_i = y_{i-1} + (x_i - y_{i-1}) / (1 + l/dx).
    Its kernel is a one-sided exponential of length l.

    T is an analytic function of l, and T = 1 at l = 0. For small pixels, T approaches 1 / (1 + i 2π f l).
    """
    # T = 1 / (1 + l/dx (1 - e^(-2i half))). Real numbers take a quarter of the time of complex ones.
    pixels, half = length_um / pitch_um, math.pi * pitch_um * frequency
    sine = half.sin()
    real, imaginary = 1 + 2 * pixels * sine**2, 2 * pixels * sine * half.cos()
    squared = real**2 + imaginary**2
    return torch.complex(real / squared, -imaginary / squared)


def gradient(field: Tensor, pitch_um: float) -> tuple[Tensor, Tensor]:
    """Return the derivatives d/dy and d/dx of a field, per µm, by central differences with
    replicated edges.
    """
    above, below, left, right = neighbours(functional.pad(field, (1, 1, 1, 1), mode="replicate"), 1)
    return (below - above) / (2 * pitch_um), (right - left) / (2 * pitch_um)


def rounded_power(squared_slope: Tensor, power: float | Tensor) -> Tensor:
    """Return a power of the absolute slope, given the squared slope. The result is smoothed near zero so that
    it is differentiable there.
    """
    return (squared_slope + _LEAST_SLOPE**2) ** (power / 2) - _LEAST_SLOPE**power


def add_warp(
    field: Tensor, shift_y_um: Tensor | float, shift_x_um: Tensor | float, pitch_um: float
) -> Tensor:
    """Sample the field at (y + shift_y, x + shift_x) by cubic interpolation. A zero shift returns the field
    bit for bit.

    Args:
        field: tensor of shape (1, 1, ny, nx).
        shift_y_um, shift_x_um: shifts in µm: maps of shape (ny, nx), or single numbers.
    """
    return field + _moved(field, shift_y_um / pitch_um, shift_x_um / pitch_um) - _moved(field, 0.0, 0.0)


def _moved(field: Tensor, shift_y_px: Tensor | float, shift_x_px: Tensor | float) -> Tensor:
    axes = zip(pixel_numbers(field), (shift_y_px, shift_x_px), field.shape[-2:], strict=True)
    # Coordinates run from -1 to 1 over the field.
    y, x = (2 * (number + shift) / max(size - 1, 1) - 1 for number, shift, size in axes)
    grid = torch.stack(torch.broadcast_tensors(x, y), dim=-1).expand(len(field), -1, -1, -1)
    return functional.grid_sample(field, grid, mode="bicubic", padding_mode="border", align_corners=True)
