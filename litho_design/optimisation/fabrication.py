"""Penalty on levels and steps that are rare in a model's training layouts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from litho_data.commands.settings import setting
from litho_data.foundation.results import Record
from litho_design.printers.training import ALLOWED_TIMES, training_share

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor


class Fabrication(Record):
    """A penalty on a layout in addition to the loss of its light: inside_weight * ``outside``."""

    FORMER: ClassVar[frozenset[str]] = frozenset({"weight", "max_step_levels", "min_feature_um"})

    inside_weight: float = setting(
        0.0, "Weight of levels and steps that the model's training layouts hardly have",
        option="--inside-weight", ge=0,
    )  # fmt: skip


def outside(level: Tensor, levels: int, card: Mapping[str, Any]) -> Tensor:
    """The excess of a layout over twice the tails of a model's training layouts, in levels.

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
            down, right = (level.diff(dim=axis).abs() for axis in (-2, -1))
            larger = [(step - (place - 1)).clamp(0, 1).mean() for step in (down, right)]
            total = total + ((larger[0] + larger[1]) / 2 - limit).clamp(min=0)
    return total
