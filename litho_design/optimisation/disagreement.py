"""How much several models disagree about the print of one layout."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_design.printers.printer import Printer, PrinterRecord

# (1e-6 µm)^2, far below any height, keeps the root differentiable where all models agree.
_SMALLEST_VARIANCE_UM2 = 1e-12


class EnsembleRecord(Record):
    """The further models of a design, and the disagreement of all of them on its layout."""

    members: list[PrinterRecord]
    disagreement_nm: float
    disagreement_waves: float


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


@torch.no_grad()
def measure_disagreement(
    printers: Sequence[Printer], level: Tensor, wave_height_um: float
) -> EnsembleRecord | None:
    """Disagreement of the models on a layout (1, 1, size, size); None for a single model."""
    if len(printers) == 1:
        return None
    apart_um = float(disagreement_um(torch.stack([printer(level)[0, 0] for printer in printers])))
    return EnsembleRecord(
        members=[printer.record() for printer in printers[1:]],
        disagreement_nm=NM_PER_UM * apart_um,
        disagreement_waves=apart_um / wave_height_um,
    )
