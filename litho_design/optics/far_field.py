"""Propagate to the far field: the focal plane of an ideal lens behind the element, where each position
corresponds to an angle.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid


class FarFieldPropagator(nn.Module):
    """Propagate a field to the focal plane of an ideal lens.

    U(p) = 1 / (j λ f) sum u(q) exp(-2πj p·q / (λ f)) dy dx. The position p corresponds to the direction whose
    sine is p / f. The sum is exact for any two grids and uses one matrix per axis. Pixels are treated as
    squares, not as points (Goodman, Fourier Optics, ch. 5).

    Args:
        source, target: grids of the two planes, µm. Their shapes and pitches may differ.
        distance_um: focal length f.

    Raises:
        InputError: the image is wider than λ f / pitch. Because the element is sampled, the computed image
            repeats beyond this width.
    """

    along_y: Tensor
    along_x: Tensor

    def __init__(
        self,
        source: PixelGrid,
        target: PixelGrid,
        distance_um: float,
        wavelength_um: float,
        *,
        dtype: torch.dtype = torch.complex64,
    ):
        super().__init__()
        self.source, self.target = source, target
        scale = wavelength_um * distance_um
        for axis, name in enumerate(("along_y", "along_x")):
            size_um, widest_um = target.size_um[axis], scale / source.pitch_um[axis]
            if size_um > widest_um * (1 + 1e-9):
                wanted = f"at least {size_um * source.pitch_um[axis] / wavelength_um:.4g} µm"
                raise InputError("focal length of the far field", got=f"{distance_um:g} µm", wanted=wanted)
            here, there = (
                torch.from_numpy(grid.y_um if axis == 0 else grid.x_um).double() for grid in (source, target)
            )
            phase = -2 * math.pi / scale * torch.outer(there, here)
            # A pixel is a square, which sends less light sideways than a point does.
            square = torch.sinc(there * source.pitch_um[axis] / scale)[:, None].expand_as(phase)
            matrix = torch.polar(square * (source.pitch_um[axis] / math.sqrt(scale)), phase)
            self.register_buffer(name, matrix.to(dtype), persistent=False)

    def forward(self, field: Tensor) -> Tensor:
        """Propagate a complex field of shape (..., ny, nx); the result has shape (..., my, mx)."""
        return -1j * (self.along_y @ field @ self.along_x.T)

    def adjoint(self, field: Tensor) -> Tensor:
        """Apply P^H, the adjoint of ``forward``, to a complex field of shape (..., my, mx). The result has
        shape (..., ny, nx).
        """
        return 1j * (self.along_y.mH @ field @ self.along_x.conj())
