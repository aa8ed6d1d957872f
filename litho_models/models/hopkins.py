"""Compute partially coherent images as a sum of coherent systems (SOCS).

Hopkins' image is I(x) = Σ T(f₁) T*(f₂) C(f₁, f₂) exp(2πi (f₁ - f₂) x), with the transmission cross
coefficients C(f₁, f₂) = Σ_s P(f₁ + s) P*(f₂ + s) over the points s of the source (Proc. R. Soc. A 217, 408
(1953)). C is A⁺A with A(s, f) = P(s + f), so the singular vectors of A are the kernels, and I = Σ_k |h_k *
t|² (Cobb, PhD thesis, Berkeley 1998).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array

# Radius in units of λ / NA at which a kernel is cut off.
_REACH = 4.0
# Number of sample points along each side of a frequency cell, for estimating the share of the cell that the
# source fills. The number is odd, so one point is at the centre.
_COUNTED = 9


class Optics(NamedTuple):
    """A projection lens and its light.

    Attributes:
        wavelength_um, na: wavelength, and numerical aperture on the image side.
        outer, inner: radii of a round or ring-shaped source, relative to the pupil; with both 0, the source
            is a point.
        defocus_um: distance of the resist from the focus.
        kernels: number of kernels that are used, the strongest first.
    """

    wavelength_um: float
    na: float
    outer: float
    inner: float
    defocus_um: float
    kernels: int


def kernel_reach_px(optics: Optics, pitch_um: float) -> int:
    """Return the number of pixels that a kernel reaches to each side."""
    return max(1, math.ceil(_REACH * optics.wavelength_um / optics.na / pitch_um))


def intensity(transmission: Tensor, optics: Optics, pitch_um: float) -> Tensor:
    """Return the intensity of the image of a mask (b, 1, y, x), relative to an open mask. A border as wide as
    the kernels' reach is cropped.
    """
    reach = kernel_reach_px(optics, pitch_um)
    spectra = _spectra(optics, pitch_um, 2 * reach + 1, *transmission.shape[-2:])
    return imaged_inside(transmission, spectra, reach)


def imaged_inside(transmission: Tensor, spectra: Tensor, reach_px: int) -> Tensor:
    """Image a mask that is not periodic; return the intensity without the outermost ``reach_px``."""
    # Fourier transforms spread rounding errors over the field. In double precision, tiles give the same
    # result as the whole field.
    image = imaged(transmission.double(), spectra.to(transmission.device))
    return functional.pad(image, (-reach_px,) * 4).to(transmission.dtype)


def imaged(transmission: Tensor, spectra: Tensor) -> Tensor:
    """Return Σ_k |h_k * t|² of a periodic mask (b, 1, y, x), with transfer functions (k, y, x) of the
    kernels.

    The mask is transformed once; the inverse transforms run in one batch over all kernels.
    """
    amplitudes = torch.fft.ifft2(torch.fft.fft2(transmission) * spectra)
    return (amplitudes.real**2 + amplitudes.imag**2).sum(dim=1, keepdim=True)


def transfer_functions(optics: Optics, pitch_um: float, shape: tuple[int, int]) -> Array:
    """Return the kernels of a periodic field (ny, nx) as transfer functions (k, ny, nx), complex.

    Source points lie on the grid of the field's frequencies, and each is weighted by the filled share of its
    cell.

    Raises:
        InputError: a ring too thin to fill any cell.
    """
    fy, fx = (np.fft.fftfreq(n, pitch_um) for n in shape)
    y, x = (one.ravel() for one in np.meshgrid(fy, fx, indexing="ij"))
    cutoff = optics.na / optics.wavelength_um
    filled = _filled(y / cutoff, x / cutoff, [1 / (n * pitch_um * cutoff) for n in shape], optics)
    source = np.flatnonzero(filled)
    if not len(source):
        raise InputError(
            "source of a lens", got=f"radii {optics.inner:g} to {optics.outer:g}", wanted="a wider ring"
        )
    # All kernels are 0 at frequencies that no source point brings into the pupil.
    reach = 1 + np.hypot(y[source], x[source]).max() / cutoff
    bright = np.flatnonzero(np.hypot(y, x) / cutoff <= reach + 1e-9)
    shifted = y[source, None] + y[bright], x[source, None] + x[bright]
    waves = np.sqrt(filled[source])[:, None] * _pupil(*shifted, optics)
    values, vectors = np.linalg.svd(waves, full_matrices=False)[1:]
    open_frame = np.sum(np.abs(waves[:, bright == 0]) ** 2)
    count = min(optics.kernels, len(values))
    found = np.zeros((count, len(y)), np.complex128)
    found[:, bright] = values[:count, None] * vectors[:count] / np.sqrt(open_frame)
    return found.reshape(count, *shape)


def _filled(y: Array, x: Array, cell: Sequence[float], optics: Optics) -> Array:
    """Return the share of each cell (y, x) that the source fills; each cell is centred on a frequency,
    relative to the pupil.
    """
    inside = (np.arange(_COUNTED) + 0.5) / _COUNTED - 0.5
    filled = np.zeros(len(y))
    for by_y in inside * cell[0]:
        for by_x in inside * cell[1]:
            radius = np.hypot(y + by_y, x + by_x)
            filled += (radius <= optics.outer + 1e-9) & (radius >= optics.inner - 1e-9)
    return filled / _COUNTED**2


def _pupil(fy: Array, fx: Array, optics: Optics) -> Array:
    """Return the amplitude that passes through the pupil, with the phase of the defocus."""
    squared = (fy**2 + fx**2) * optics.wavelength_um**2
    inside = squared <= optics.na**2 * (1 + 1e-9)
    along = np.sqrt(np.where(inside, 1 - squared, 1.0)) - 1
    return inside * np.exp(2j * math.pi * optics.defocus_um / optics.wavelength_um * along)


@lru_cache(maxsize=2)
def _spectra(optics: Optics, pitch_um: float, size_px: int, ny: int, nx: int) -> Tensor:
    """Return the spectra (``spectra_of``) of a lens's kernels, cropped to ``size_px``."""
    kernels = np.fft.ifft2(transfer_functions(optics, pitch_um, (size_px, size_px)))
    return spectra_of(np.fft.fftshift(kernels, axes=(-2, -1)), ny, nx)


def spectra_of(kernels: np.ndarray, ny: int, nx: int) -> Tensor:
    """Return the transfer functions (k, ny, nx) of kernels (k, size, size) around their middle pixel."""
    size_px = kernels.shape[-1]
    reach = size_px // 2
    placed = np.zeros((len(kernels), ny, nx), np.complex128)
    placed[:, :size_px, :size_px] = kernels
    placed = np.roll(placed, (-reach, -reach), axis=(-2, -1))
    # An open mask has intensity 1 for any number of kernels.
    spectra = np.fft.fft2(placed)
    spectra /= np.sqrt(np.sum(np.abs(spectra[:, 0, 0]) ** 2))
    return torch.from_numpy(spectra)
