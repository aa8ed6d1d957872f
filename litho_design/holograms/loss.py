"""The loss of a hologram.

To add a term to the loss, add a field for its weight to ``HologramLoss`` and a line for its value to
``hologram_loss``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from litho_design.holograms.settings import HologramLoss


def counted_pixels(target: Tensor, settings: HologramLoss, pitch_um: float) -> Tensor | None:
    """Return a boolean mask, shape (size, size), of the pixels on which the error of the image is computed.
    The mask is True within a distance of ``signal_window_um`` from a pixel whose target is above zero. Return
    None if the error is computed on all pixels.
    """
    if not settings.signal_window_um:
        return None
    from scipy.ndimage import distance_transform_edt

    away_um = distance_transform_edt((target <= 0).cpu().numpy()) * pitch_um
    return torch.from_numpy(away_um <= settings.signal_window_um).to(target.device)


def hologram_loss(
    share: Tensor,
    target: Tensor,
    settings: HologramLoss,
    counted: Tensor | None = None,
    total: Callable[[Tensor], Tensor] | None = None,
) -> tuple[Tensor, dict[str, float]]:
    """Return the loss of an image, and a dict of the named parts of this loss.

    Args:
        share: share of the incident power on each pixel of the image, shape (size, size).
        target: target intensity in [0, 1], shape (size, size).
        counted: boolean mask, shape (size, size), of the pixels on which the error is computed, or None for
            all pixels.
        total: function that sums values over the pixels of the whole image. It is needed only if ``share``,
            ``target`` and ``counted`` cover only a part of the image.
    """
    total = total or torch.sum
    efficiency = total(share[target > 0])
    if counted is not None:
        share, target = share[counted], target[counted]
    lit = total(share * target)
    factor = (
        total(target) / lit if settings.scale == "paper" else lit / total(share.square()).clamp(min=1e-30)
    )
    rmse = (total((factor * share - target).square()) / total(torch.ones_like(target))).sqrt()
    loss = rmse + settings.efficiency_weight * (1 - efficiency)
    return loss, {"rmse": float(rmse.detach()), "efficiency": float(efficiency.detach())}
