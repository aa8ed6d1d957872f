"""The loss of a hologram.

To add a term, give it a weight in ``HologramLoss`` and a line in ``hologram_loss``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from litho_data.commands.settings import setting
from litho_data.foundation.results import Record

if TYPE_CHECKING:
    from torch import Tensor


class HologramLoss(Record):
    """RMSE(target, image) + efficiency_weight * (1 - efficiency).

    With ``signal_window_um``, only pixels within this distance of the wanted light count in the error; light
    beyond them is free (mixed-region amplitude freedom: Pasienski and DeMarco 2008,
    doi:10.1364/OE.16.002176). ``scale`` matches the image to the target: ``paper`` divides by the mean over
    the wanted light, ``least-squares`` uses the factor with the smallest error. The efficiency is the share
    of the incident power on pixels whose target is above zero.
    """

    scale: Literal["paper", "least-squares"] = setting(
        "paper", "How the image is scaled to match the target", option="--loss-scale"
    )
    efficiency_weight: float = setting(
        0.1, "Weight of the light that misses the target", option="--efficiency-weight", ge=0
    )
    signal_window_um: float = setting(
        0.0, "Light further from the wanted light than this is free; 0 for none", unit="µm",
        option="--signal-window-um", ge=0,
    )  # fmt: skip


def counted_pixels(target: Tensor, settings: HologramLoss, pitch_um: float) -> Tensor | None:
    """Pixels (size, size) near the wanted light, which count in the error; None for all."""
    if not settings.signal_window_um:
        return None
    import torch
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
    """Loss of an image and its parts by name.

    Args:
        share: share of the incident power on each pixel (size, size).
        target: wanted intensity in [0, 1], (size, size).
        counted: pixels that count in the error, bool (size, size); None for all.
        total: sums over the pixels of the whole image, if the other arguments are a part of it; otherwise
            None.
    """
    import torch  # imported late, because the command line reads the weights without it

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
