"""Several models of one printer: where they disagree, none of them should be trusted."""

from __future__ import annotations

import torch
from pydantic import Field
from torch import Tensor

from litho_data.foundation.results import Record
from litho_design.printers.printer import PrinterRecord

# (1e-6 µm)^2: keeps the root differentiable where all models agree, and is far below any height.
_SMALLEST_VARIANCE_UM2 = 1e-12


class EnsemblePenalty(Record):
    """With further models in the search, the loss is their mean loss + weight * disagreement in waves."""

    weight: float = Field(default=1.0, ge=0)


class EnsembleRecord(Record):
    """The further models of a design, and how far all of them are apart on its layout."""

    members: list[PrinterRecord]
    disagreement_nm: float
    disagreement_waves: float


def disagreement_um(heights_um: Tensor, area: Tensor | None = None) -> Tensor:
    """RMS over the area of the standard deviation between models, µm; differentiable.

    A constant height is a constant phase, so every print is first freed of its mean.

    Args:
        heights_um: prints of one layout by k models, (k, ...).
        area: what each height stands for, (...), in any unit: rings grow outwards; None for pixels.
    """
    flat = heights_um.flatten(1)
    share = torch.ones_like(flat[0]) if area is None else area.flatten()
    share = share / share.sum()
    free = flat - (flat * share).sum(1, keepdim=True)
    return ((free.var(0, correction=0) * share).sum() + _SMALLEST_VARIANCE_UM2).sqrt()


def penalised(
    loss: Tensor, heights_um: list[Tensor], weight: float, wave_height_um: float, area: Tensor | None = None
) -> Tensor:
    """``loss`` + weight * disagreement in waves; the loss itself where there is one model only."""
    if len(heights_um) == 1 or weight == 0:
        return loss
    return loss + weight * disagreement_um(torch.stack(heights_um), area) / wave_height_um
