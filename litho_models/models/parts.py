"""The parts of a printer: pure functions from one field to the next, each with its physics.

Fields are (batch, 1, y, x), relative to a full dose or height; values are tensors, which can be fitted.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from litho_models.layers.gaussian import blur_interior, kernel_radius_px
from litho_models.simulator import crop_border

# Change of the resist from pixel to pixel below which there is no edge.
_FLATTEST = 5e-3


def spot_radius_px(sigma_um: Tensor | float, pitch_um: float) -> int:
    """Pixels that a Gaussian spot reaches."""
    # In float32 a width is never quite itself: its last digits must not move the edge of the kernel.
    return kernel_radius_px(round(float(torch.as_tensor(sigma_um).detach()), 6) / pitch_um)


def illuminate(
    pattern: Tensor, spots: Sequence[tuple[Tensor | float, Tensor]], pitch_um: float, reach_px: int
) -> Tensor:
    """Illumination: exposure by a spot of several Gaussians, Σ share · G_sigma; cut by ``reach_px``.

    One for light or a fine beam; a second, wide one for electrons that come back (Chang, J. Vac. Sci.
    Technol. 12, 1271 (1975)); a third between them.

    Args:
        pattern: what is written; ``spots``: share and standard deviation (µm) of each; ``pitch_um``: of it.
        reach_px: the widest reach of them or more.
    """
    total = torch.zeros(())
    for share, sigma_um in spots:
        radius = spot_radius_px(sigma_um, pitch_um)
        total = total + share * blur_interior(
            crop_border(pattern, reach_px - radius), sigma_um / pitch_um, radius
        )
    return total


def project(exposure: Tensor, steepness: Tensor, threshold: Tensor) -> Tensor:
    """Resist: smoothed threshold, 0 at 0 and 1 at 1 (Wang et al. 2011, doi:10.1007/s00158-010-0602-y)."""
    low = torch.tanh(steepness * threshold)
    return (low + torch.tanh(steepness * (exposure - threshold))) / (
        low + torch.tanh(steepness * (1 - threshold))
    )


def hill(exposure: Tensor, contrast: Tensor, threshold: Tensor) -> Tensor:
    """Resist: share that a dose turns, E^γ / (E^γ + η^γ), of contrast γ; a half at the threshold η."""
    turned = exposure.clamp(min=1e-6) ** contrast
    return turned / (turned + threshold**contrast)


def etch(resist: Tensor, threshold: Tensor | float, bias_um: Tensor | float, pitch_um: float) -> Tensor:
    """Transfer: coverage of a film etched where resist stands above the threshold; cut by one pixel.

    The edge lies where the resist crosses the threshold, moved outward by the bias; a pixel that it crosses
    is covered in part: a sigmoid, one pixel wide, of the distance (resist - threshold) / |∇ resist| + bias.
    """
    slope_y = (resist[..., 2:, 1:-1] - resist[..., :-2, 1:-1]) / 2
    slope_x = (resist[..., 1:-1, 2:] - resist[..., 1:-1, :-2]) / 2
    slope = torch.sqrt(slope_y**2 + slope_x**2 + _FLATTEST**2)
    return torch.sigmoid(4 * ((crop_border(resist, 1) - threshold) / slope + bias_um / pitch_um))
