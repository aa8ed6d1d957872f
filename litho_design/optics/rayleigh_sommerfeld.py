"""Propagate by the Rayleigh-Sommerfeld integral, computed as an exact discrete convolution between two
planes.
"""

from __future__ import annotations

import math
from fractions import Fraction

import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid
from litho_design.optics.convolution import KernelPropagator, fine_shape, wrapped_order
from litho_design.optics.sampling import check_distance, first_centre_um

_LARGEST_RATIO = 16


class RSPropagator(KernelPropagator):
    """Propagate a complex field from one plane to a parallel plane (first Rayleigh-Sommerfeld integral).

    U(p) = sum over source pixels q of u(q) h(p - q) dy dx, with h = z / (2 pi r^2) (1/r - j k) exp(j k r),
    r^2 = x^2 + y^2 + z^2 and k = 2 pi / wavelength. In the time convention used here, exp(+j k r) is a wave
    that runs outwards (Goodman, Fourier Optics, ch. 3). The sum is computed exactly, because the kernel
    covers all separations between the two grids. If the two pitches differ, they must be in a ratio of small
    integers. The kernel is then sampled at the largest pitch that fits into both pitches a whole number of
    times.

    Args:
        source, target: grids of the two planes, with origin and pitch in µm.
        distance_um: separation of the planes, µm.
        wavelength_um: wavelength in the medium, µm.
        dtype: torch.complex64 or torch.complex128; kernels are computed in double precision.

    Raises:
        InputError: the distance is below the sampling limit, or the pitches are not in a ratio of integers up
            to 16.
    """

    def __init__(
        self,
        source: PixelGrid,
        target: PixelGrid,
        distance_um: float,
        wavelength_um: float,
        *,
        dtype: torch.dtype = torch.complex64,
    ):
        check_distance(distance_um, source, target, wavelength_um)
        ratios = [_ratio(there / here) for here, there in zip(source.pitch_um, target.pitch_um, strict=True)]
        if None in ratios:
            raise InputError(
                "pitch of the output grid",
                got=f"{target.pitch_um} µm for a source pitch of {source.pitch_um} µm",
                wanted=f"a ratio of integers up to {_LARGEST_RATIO}",
            )
        (here_y, there_y), (here_x, there_x) = (one for one in ratios if one)
        finer = (here_y, here_x), (there_y, there_x)
        y, x = (
            first_centre_um(target, axis) - first_centre_um(source, axis)
            + wrapped_order(here, there).double() * (source.pitch_um[axis] / finer[0][axis])
            for axis, (here, there) in enumerate(
                zip(fine_shape(source.shape, finer[0]), fine_shape(target.shape, finer[1]), strict=True)
            )
        )  # fmt: skip
        kernel = rs_kernel(y[:, None], x[None, :], distance_um, wavelength_um) * math.prod(source.pitch_um)
        super().__init__(source, target, kernel, dtype, finer)


def _ratio(pitches: float) -> tuple[int, int] | None:
    """Find the largest pitch that fits into the pitches of two grids a whole number of times. Return these
    two numbers, first the number for the first grid. ``pitches`` is the second pitch divided by the first.
    Return None if one of the two numbers would exceed 16.
    """
    found = Fraction(pitches).limit_denominator(_LARGEST_RATIO)
    if found.numerator > _LARGEST_RATIO or abs(found / Fraction(pitches) - 1) > 1e-12:
        return None
    return found.denominator, found.numerator


def rs_kernel(y_um: Tensor, x_um: Tensor, distance_um: float, wavelength_um: float) -> Tensor:
    """Return the kernel h(x, y) of the first Rayleigh-Sommerfeld integral, 1/µm^2, complex128. The
    separations ``y_um`` and ``x_um`` are broadcast against each other.
    """
    wavenumber = 2 * math.pi / wavelength_um
    squared = y_um.double() ** 2 + x_um.double() ** 2 + distance_um**2
    radius = squared.sqrt()
    factor = torch.complex(1 / radius, torch.full_like(radius, -wavenumber))
    factor *= distance_um / (2 * math.pi * squared)
    return factor * torch.polar(torch.ones_like(radius), wavenumber * radius)
