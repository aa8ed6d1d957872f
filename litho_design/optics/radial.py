"""Propagate ring-symmetric fields by the Rayleigh-Sommerfeld integral, as a matrix product instead of a 2-D
transform.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_design.optics.rayleigh_sommerfeld import rs_kernel

_CHUNK_ENTRIES = 1 << 23


class RadialPropagator(nn.Module):
    """Propagate a field of concentric rings to points at given radii of a parallel plane.

    The propagated field U(p) is a sum over all rings. Each ring contributes its field u times the integral of
    h over the ring, where h is the kernel in ``RSPropagator``. The integral over a ring uses two
    Gauss-Legendre nodes across the ring and the midpoint rule around it. The integrand is periodic around the
    ring. As soon as the steps resolve its phase, the error of the midpoint rule therefore decreases
    exponentially with the number of steps.

    Args:
        rings: number of rings; ring i covers the radii from i to i + 1 times ``ring_width_um``.
        ring_width_um: width of each ring, µm.
        target_radius_um: radii of the output points, shape (n,), µm.
        distance_um, wavelength_um: as in ``RSPropagator``.

    Raises:
        InputError: the distance is not positive.
    """

    matrix: Tensor

    def __init__(
        self,
        rings: int,
        ring_width_um: float,
        target_radius_um: Tensor,
        distance_um: float,
        wavelength_um: float,
        *,
        dtype: torch.dtype = torch.complex64,
    ):
        super().__init__()
        if not distance_um > 0:
            raise InputError(
                "propagation distance", got=f"{distance_um} µm", wanted="a positive number in µm"
            )
        self.rings, self.ring_width_um = rings, ring_width_um
        self.register_buffer("target_radius_um", target_radius_um.double(), persistent=False)
        matrix = _ring_matrix(rings, ring_width_um, target_radius_um.double(), distance_um, wavelength_um)
        self.register_buffer("matrix", matrix.to(dtype), persistent=False)

    @property
    def ring_area_um2(self) -> Tensor:
        """Return the area of each ring, µm^2, float64 of shape (rings,). The power of a field u is the sum of
        |u|^2 times this area.
        """
        return math.pi * self.ring_width_um**2 * (2 * torch.arange(self.rings, dtype=torch.float64) + 1)

    def forward(self, field: Tensor) -> Tensor:
        """Propagate a complex field of shape (..., rings); the result has shape (..., n)."""
        return field @ self.matrix.T


def _ring_matrix(
    rings: int, ring_width_um: float, target_radius_um: Tensor, distance_um: float, wavelength_um: float
) -> Tensor:
    half = ring_width_um / 2
    middle = (torch.arange(rings, dtype=torch.float64) + 0.5) * ring_width_um
    nodes = torch.stack([middle - half / math.sqrt(3), middle + half / math.sqrt(3)], dim=1).flatten()
    angle, angle_step = _half_circle(float(nodes.max()), target_radius_um, distance_um, wavelength_um)
    chunk = max(1, _CHUNK_ENTRIES // (nodes.numel() * angle.numel()))
    rows = []
    for radius in target_radius_um.split(chunk):
        x = nodes[None, :, None] * angle.cos() - radius[:, None, None]
        y = nodes[None, :, None] * angle.sin()
        around = rs_kernel(y, x, distance_um, wavelength_um).sum(-1) * (2 * angle_step)
        rows.append((around * nodes * half).unflatten(-1, (rings, 2)).sum(-1))
    return torch.cat(rows)


def _half_circle(
    source_radius_um: float, target_radius_um: Tensor, distance_um: float, wavelength_um: float
) -> tuple[Tensor, float]:
    """Return the midpoints of equal steps between the angles 0 and pi, and the size of a step. The steps are
    small enough to resolve the fastest change of the phase around any ring.
    """
    target = float(target_radius_um.max())
    far = math.hypot(source_radius_um + target, distance_um)
    near = math.hypot(source_radius_um - target, distance_um)
    count = math.ceil(2 * math.pi * (far - near) / wavelength_um) + 32
    step = math.pi / count
    return (torch.arange(count, dtype=torch.float64) + 0.5) * step, step
