"""The loss of several prints of one layout: by several models, over the draws of a process window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_design.optimisation.process_window import Draw, ProcessWindow, risk
from litho_design.printers.printer import Printer, PrinterRecord

# (1e-6 µm)^2: keeps the root differentiable where all models agree, and is far below any height.
_SMALLEST_VARIANCE_UM2 = 1e-12

Loss = Callable[[Tensor, Any], tuple[Tensor, dict[str, float]]]


def windowed_loss(
    prints: Sequence[Tensor],
    scenes: Sequence[tuple[Draw | None, Any]],
    loss: Loss,
    window: ProcessWindow,
    pitch_um: float,
) -> tuple[Tensor, dict[str, float]]:
    """The loss of one or several prints of a layout, over the draws of a process window.

    Args:
        prints: printed heights of the same layout by one or several models.
        scenes: pairs of a draw (None for the print as modelled) and its optics.
        loss: height and optics to a loss and its parts.

    Returns:
        The mean over the prints; over several scenes, the risk of that mean. Parts are those of the
        first print, or mean and worst over the scenes.
    """
    losses: list[Tensor] = []
    parts: dict[str, float] = {}
    for draw, bench in scenes:
        drawn = [height if draw is None else draw.apply(height, pitch_um) for height in prints]
        results = [loss(height, bench) for height in drawn]
        parts = parts or results[0][1]
        losses.append(torch.stack([value for value, _ in results]).mean())
    if len(losses) == 1:
        return losses[0], parts
    together = torch.stack(losses)
    seen = together.detach()
    return risk(together, window), {"mean": float(seen.mean()), "worst": float(seen.max())}


class EnsembleRecord(Record):
    """The further models of a design, and the disagreement of all of them on its layout."""

    members: list[PrinterRecord]
    disagreement_nm: float
    disagreement_waves: float


def disagreement_um(heights_um: Tensor, area: Tensor | None = None) -> Tensor:
    """RMS over the area of the standard deviation between models, µm; differentiable.

    A constant height is only a constant phase, so the mean of every print is subtracted first.

    Args:
        heights_um: prints of one layout by k models, (k, ...).
        area: area that each height covers, (...), in any unit, as for rings; None for pixels.
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
