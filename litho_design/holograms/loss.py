"""What a hologram is optimised for.

To add a term, give it a weight in ``HologramLoss`` and a line in ``hologram_loss``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from litho_data.foundation.results import Record
from litho_data.foundation.settings import setting

if TYPE_CHECKING:
    from torch import Tensor


class HologramLoss(Record):
    """RMSE(target, image) + efficiency_weight * (1 - efficiency).

    ``scale`` matches the image to the target: ``paper`` divides by the mean over the wanted light,
    ``least-squares`` uses the factor of least error. The efficiency is
    the share of the incident power on pixels whose target is above zero.
    """

    scale: Literal["paper", "least-squares"] = setting(
        "paper", "How the image is scaled to match the target", option="--loss-scale"
    )
    efficiency_weight: float = setting(
        0.1, "Weight of the light that misses the target", option="--efficiency-weight", ge=0
    )


def hologram_loss(share: Tensor, target: Tensor, settings: HologramLoss) -> tuple[Tensor, dict[str, float]]:
    """Loss of an image and its parts by name.

    Args:
        share: share of the incident power on each pixel (size, size).
        target: wanted intensity in [0, 1], (size, size).
    """
    # Not at the top: the command line reads the weights without torch.
    from litho_design.images.similarity import matched_scale

    lit = (share * target).sum()
    factor = target.sum() / lit if settings.scale == "paper" else matched_scale(share, target)
    rmse = (factor * share - target).square().mean().sqrt()
    efficiency = share[target > 0].sum()
    loss = rmse + settings.efficiency_weight * (1 - efficiency)
    return loss, {"rmse": float(rmse.detach()), "efficiency": float(efficiency.detach())}
