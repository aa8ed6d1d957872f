"""How much several models disagree about the print of one layout."""

from __future__ import annotations

import torch
from torch import Tensor

# (1e-6 µm)^2, far below any height, keeps the root differentiable where all models agree.
_SMALLEST_VARIANCE_UM2 = 1e-12


def disagreement_um(heights_um: Tensor, area: Tensor | None = None) -> Tensor:
    """RMS over the area of the standard deviation among models, µm; differentiable.

    A constant height is only a constant phase, so the mean of every print is subtracted first.

    Args:
        heights_um: prints of one layout by k models, (k, ...).
        area: area that each height covers, (...), in any unit, for rings; None for pixels.
    """
    flat = heights_um.flatten(1)
    share = torch.ones_like(flat[0]) if area is None else area.flatten()
    share = share / share.sum()
    free = flat - (flat * share).sum(1, keepdim=True)
    return ((free.var(0, correction=0) * share).sum() + _SMALLEST_VARIANCE_UM2).sqrt()
