"""Apply effects before and after a base model, and select the part of this chain that designs may use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from torch import Tensor, nn

from litho_models.effects.effect import ActsOn, FieldContext
from litho_models.effects.registry import get_effect, in_forward_order
from litho_models.simulator import Simulator, Tile

# Whether an effect turns with the print or with the scan.
Frame = Literal["scan", "print"]


class EffectChain(nn.Module):
    """Apply layout effects, then the base model, then height effects, in the order of the catalogue.

    Args:
        base: a simulator, layout (b, 1, y, x) µm -> height (b, 1, y, x) µm.
        effects: parameter values by the name of the effect; parameters that are not given are off.
        frames: whether a height effect turns with the print or with the scan, if that differs from the
            default: effects of stage ``measurement`` turn with the scan, all others with the print.
    """

    def __init__(
        self,
        base: nn.Module,
        effects: Mapping[str, Mapping[str, float]],
        frames: Mapping[str, Frame] | None = None,
    ):
        super().__init__()
        self.base = base
        self.frames = frames or {}
        self.values = {
            name: get_effect(name).with_values(effects[name]) for name in in_forward_order(list(effects))
        }

    @property
    def tile(self) -> Tile | None:
        """Return the tile of the base model; effects act on the whole field."""
        return self.base.tile if isinstance(self.base, Simulator) else None

    def forward(self, layout_um: Tensor, context: FieldContext | None = None) -> Tensor:
        """Return the height (b, 1, y, x), µm. Without a context the field is one write field."""
        if context is None:
            assert isinstance(self.base, Simulator)
            geometry = self.base.config
            context = FieldContext(
                layout_um, geometry.pitch_um, geometry.full_height_um, geometry.level_height_um
            )
        return self.after_base(self.base(self.before_base(layout_um, context)), context)

    def before_base(self, layout_um: Tensor, context: FieldContext) -> Tensor:
        """Apply the effects that act before the base model to the layout."""
        return self._run_stage("layout", layout_um, context)

    def after_base(self, height_um: Tensor, context: FieldContext) -> Tensor:
        """Apply the height effects to the base model's height."""
        return self._run_stage("height", height_um, context)

    def _run_stage(self, acts_on: ActsOn, field: Tensor, context: FieldContext) -> Tensor:
        for name, values in self.values.items():
            effect = get_effect(name)
            if effect.acts_on == acts_on:
                usual = "scan" if effect.stage == "measurement" else "print"
                scanned = self.frames.get(name, usual) == "scan"
                field = effect(field, values, context, scanned=scanned)
        return field
