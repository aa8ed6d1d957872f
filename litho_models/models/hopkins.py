"""Compute the partially coherent image of a mask as a sum of coherent systems (SOCS).

In Hopkins' theory (Proc. R. Soc. A 217, 408 (1953)), the intensity is I(x) = Σ T(f₁) T*(f₂) C(f₁, f₂) exp(2πi
(f₁ - f₂) x), where T is the spectrum of the mask t. The transmission cross coefficients are C(f₁, f₂) = Σ_s
P(f₁ + s) P*(f₂ + s), a sum over the points s of the source, where P is the pupil. C is the matrix A⁺A with
A(s, f) = P(s + f). Therefore I = Σ_k |h_k * t|² (Cobb, PhD thesis, Berkeley 1998). The transfer functions of
the kernels h_k are the right singular vectors of A, each multiplied by its singular value.
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

# Radius at which a kernel is cut off, in units of λ / NA.
_REACH = 4.0
# Number of sample points along each side of a frequency cell. The points are used to estimate the share of
# the cell that the source fills. Their number is odd, so one point is at the centre of the cell.
_COUNTED = 9


class Optics(NamedTuple):
    """A projection lens and its illumination.

    Attributes:
        wavelength_um, na: wavelength, µm, and numerical aperture on the image side.
        outer, inner: outer and inner radius of a round or ring-shaped source, relative to the radius of the
            pupil. If both are 0, the source is a point.
        defocus_um: distance of the resist from the focus, µm.
        kernels: number of kernels to use. The kernels with the largest singular values are used.
    """

    wavelength_um: float
    na: float
    outer: float
    inner: float
    defocus_um: float
    kernels: int


def kernel_reach_px(optics: Optics, pitch_um: float) -> int:
    """Return the radius of a kernel in pixels."""
    return max(1, math.ceil(_REACH * optics.wavelength_um / optics.na / pitch_um))


def intensity(transmission: Tensor, optics: Optics, pitch_um: float) -> Tensor:
    """Return the intensity of the image of a mask, relative to the intensity of an open mask. The mask has
    shape (batch, 1, ny, nx). The result is smaller than the mask: a border as wide as the radius of the
    kernels is cropped on each side.
    """
    reach = kernel_reach_px(optics, pitch_um)
    spectra = _spectra(optics, pitch_um, 2 * reach + 1, *transmission.shape[-2:])
    return imaged_inside(transmission, spectra, reach)


def imaged_inside(transmission: Tensor, spectra: Tensor, reach_px: int) -> Tensor:
    """Return the intensity of the image of a mask that is not periodic. The outermost ``reach_px`` pixels are
    cropped from the image.
    """
    # Fourier transforms spread rounding errors over the whole field. In double precision, the rounding errors
    # are so small that computing the image in tiles gives the same result as computing it at once.
    image = imaged(transmission.double(), spectra.to(transmission.device))
    return functional.pad(image, (-reach_px,) * 4).to(transmission.dtype)


def imaged(transmission: Tensor, spectra: Tensor) -> Tensor:
    """Return the intensity Σ_k |h_k * t|² of the image of a periodic mask t. The mask has shape (batch, 1,
    ny, nx). ``spectra`` contains the transfer functions of the kernels h_k, with shape (kernels, ny, nx).

    The mask is transformed once, and the inverse transforms for all kernels are computed in one batch.
    """
    amplitudes = torch.fft.ifft2(torch.fft.fft2(transmission) * spectra)
    return (amplitudes.real**2 + amplitudes.imag**2).sum(dim=1, keepdim=True)


def transfer_functions(optics: Optics, pitch_um: float, shape: tuple[int, int]) -> Array:
    """Return the complex transfer functions of the kernels of a lens, for a periodic field of shape (ny, nx).
    The result has shape (kernels, ny, nx).

    The source is sampled on the frequency grid of the field. Each sample represents one cell of this grid,
    and its weight is the share of the cell that the source fills.

    Raises:
        InputError: the source is a ring that is too thin for this grid.
    """
    fy, fx = (np.fft.fftfreq(n, pitch_um) for n in shape)
    y, x = (one.ravel() for one in np.meshgrid(fy, fx, indexing="ij"))
    cutoff = optics.na / optics.wavelength_um
    filled = _filled(y / cutoff, x / cutoff, [1 / (n * pitch_um * cutoff) for n in shape], optics)
    source = np.flatnonzero(filled)
    if not len(source):
        raise InputError(
            "source of the lens",
            got=f"a ring of radii {optics.inner:g} to {optics.outer:g}",
            wanted="a wider ring",
        )
    # All kernels are zero at frequencies that no point of the source shifts into the pupil.
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
    """Return the share of each frequency cell that the source fills. ``y`` and ``x`` are the coordinates of
    the centres of the cells, and ``cell`` is the size of a cell. All are relative to the radius of the pupil.
    """
    inside = (np.arange(_COUNTED) + 0.5) / _COUNTED - 0.5
    filled = np.zeros(len(y))
    for by_y in inside * cell[0]:
        for by_x in inside * cell[1]:
            radius = np.hypot(y + by_y, x + by_x)
            filled += (radius <= optics.outer + 1e-9) & (radius >= optics.inner - 1e-9)
    return filled / _COUNTED**2


def _pupil(fy: Array, fx: Array, optics: Optics) -> Array:
    """Return the complex amplitude that passes through the pupil at each frequency. The phase of the
    amplitude describes the defocus.
    """
    squared = (fy**2 + fx**2) * optics.wavelength_um**2
    inside = squared <= optics.na**2 * (1 + 1e-9)
    along = np.sqrt(np.where(inside, 1 - squared, 1.0)) - 1
    return inside * np.exp(2j * math.pi * optics.defocus_um / optics.wavelength_um * along)


@lru_cache(maxsize=2)
def _spectra(optics: Optics, pitch_um: float, size_px: int, ny: int, nx: int) -> Tensor:
    """Crop the kernels of a lens to ``size_px`` pixels, and return their transfer functions on a field of
    shape (ny, nx), in the form that ``spectra_of`` returns.
    """
    kernels = np.fft.ifft2(transfer_functions(optics, pitch_um, (size_px, size_px)))
    return spectra_of(np.fft.fftshift(kernels, axes=(-2, -1)), ny, nx)


def spectra_of(kernels: np.ndarray, ny: int, nx: int) -> Tensor:
    """Return the transfer functions of kernels on a field of shape (ny, nx). The kernels have shape (kernels,
    size, size), and their middle pixel is the origin. The result has shape (kernels, ny, nx).
    """
    size_px = kernels.shape[-1]
    reach = size_px // 2
    placed = np.zeros((len(kernels), ny, nx), np.complex128)
    placed[:, :size_px, :size_px] = kernels
    placed = np.roll(placed, (-reach, -reach), axis=(-2, -1))
    # The kernels are scaled so that an open mask has intensity 1, whatever their number.
    spectra = np.fft.fft2(placed)
    spectra /= np.sqrt(np.sum(np.abs(spectra[:, 0, 0]) ** 2))
    return torch.from_numpy(spectra)
