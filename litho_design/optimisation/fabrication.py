"""Limits of the printer as a penalty in the loss: steps, fine features, levels rare in training layouts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from litho_data.commands.settings import setting
from litho_data.foundation.results import Record
from litho_design.printers.training import ALLOWED_TIMES, training_share

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from litho_design.printers.layout import LayoutSettings


# Weight of the penalties on steps and features.
_WEIGHT = 3.0


class Fabrication(Record):
    """Penalties on a layout in addition to the loss of its light.

    loss + 3 * (excess of steps + height of fine features) + inside_weight * ``outside``. The first penalty is
    the mean of (step - max_step_levels)^2 over neighbouring pixels whose step exceeds the limit. The second
    is what a grey opening and closing by ``min_feature_um`` remove along rows and columns, or along a radius
    of rings: ridges and grooves narrower than that. Both are relative to the highest level.
    """

    max_step_levels: int = setting(
        0, "Steps between neighbouring pixels above this are penalised; 0 for none", unit="levels",
        option="--max-step-levels", ge=0,
    )  # fmt: skip
    min_feature_um: float = setting(
        0.0, "Ridges and grooves narrower than this are penalised; 0 for none", unit="µm",
        option="--min-feature-um", ge=0,
    )  # fmt: skip
    inside_weight: float = setting(
        0.0, "Weight of levels and steps that the model's training layouts hardly have",
        option="--inside-weight", ge=0,
    )  # fmt: skip


def fabrication_penalty(
    level: Tensor, settings: Fabrication, layout: LayoutSettings, card: Mapping[str, Any]
) -> Tensor | None:
    """The penalty on levels (1, 1, size, size), whole or real; None without any limit."""
    terms = []
    if settings.max_step_levels:
        terms.append(_WEIGHT * _step_excess(level, settings.max_step_levels, layout.levels))
    if settings.min_feature_um:
        width = round(settings.min_feature_um / layout.pitch_um)
        rows = level[:, :, layout.size_px // 2, None] if layout.symmetry == "radial" else level
        terms.append(_WEIGHT * _fine_features(rows, width, layout.levels))
    if settings.inside_weight:
        terms.append(settings.inside_weight * outside(level, layout.levels, card))
    return sum(terms[1:], terms[0]) if terms else None


def outside(level: Tensor, levels: int, card: Mapping[str, Any]) -> Tensor:
    """By how much a layout exceeds twice the tails of a model's training layouts, in levels.

    For every k, three shares are compared: of pixels at level k or lower, of pixels at k or higher, and of
    neighbours with steps of k or more. The result is the sum of their excesses over twice the share in the
    training layouts; 0 if the card has none. A sum of tails, unlike a sum of shares, also attracts a pixel
    that is several levels outside.
    """
    total = level.new_zeros(())
    trained, trained_steps = (
        training_share(card, name, levels) for name in ("training_level_share", "training_step_share")
    )
    for place in range(1, levels):
        if trained is not None:
            higher = (level - (place - 1)).clamp(0, 1).mean()
            limit = float(trained[place:].sum())
            total = total + (higher - ALLOWED_TIMES * limit).clamp(min=0)
            total = total + (1 - higher - ALLOWED_TIMES * (1 - limit)).clamp(min=0)
        if trained_steps is not None:
            limit = ALLOWED_TIMES * float(trained_steps[place:].sum())
            larger = [(step - (place - 1)).clamp(0, 1).mean() for step in _steps(level)]
            total = total + (sum(larger[1:], larger[0]) / 2 - limit).clamp(min=0)
    return total


def _steps(level: Tensor) -> list[Tensor]:
    return [level.diff(dim=axis).abs() for axis in (-2, -1)]


def _step_excess(level: Tensor, allowed: int, levels: int) -> Tensor:
    excess = [((step - allowed).clamp(min=0) / (levels - 1)).square().mean() for step in _steps(level)]
    return sum(excess[1:], excess[0])


def _fine_features(level: Tensor, width: int, levels: int) -> Tensor:
    """Mean height that opening and closing by ``width`` pixels remove along rows and columns."""
    lines = [level] if level.shape[-2] == 1 else [level, level.transpose(-1, -2)]
    taken = [(_opened(one, width) - one).abs() + (one + _opened(-one, width)).abs() for one in lines]
    return sum((one.mean() for one in taken), level.new_zeros(())) / (levels - 1)


def _opened(rows: Tensor, width: int) -> Tensor:
    """Grey opening along x: the highest of the minima of all runs of ``width`` pixels around a pixel."""
    import torch.nn.functional as F

    flat = rows.flatten(0, -2)[:, None]
    # Values continue beyond the border, because a feature there may continue in a neighbour.
    padded = F.pad(flat, (width - 1, width - 1), mode="replicate")
    lowest = -F.max_pool1d(-padded, width, 1)
    return F.max_pool1d(lowest, width, 1).reshape(rows.shape)
