"""Apply effects before and after a base model."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Literal

from torch import Tensor, nn

from litho_models.effects.effect import ActsOn, FieldContext
from litho_models.effects.registry import get_effect, in_forward_order
from litho_models.simulator import Simulator, Tile

# The frame of an effect: whether the effect rotates with the print or with the scan.
Frame = Literal["scan", "print"]
# Key of a cached field: everything on which the field depends, which is the effects before it, their values,
# and the base.
Key = tuple[object, ...]
Fields = MutableMapping[Key, Tensor]


class EffectChain(nn.Module):
    """Apply layout effects, then the base model, then height effects, in the order of the catalogue.

    Args:
        base: a simulator that maps a layout in µm to a height in µm. Both tensors have shape (b, 1, ny, nx).
        effects: parameter values of each effect, by its name. A parameter that is not given has the value
            that it has while its effect is off.
        frames: for each effect that deviates from the default, whether it rotates with the print or with the
            scan. By default, effects of stage ``measurement`` rotate with the scan, and all others rotate
            with the print.
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
            name: get_effect(name).with_values(effects[name]) for name in in_forward_order(effects)
        }

    @property
    def tile(self) -> Tile | None:
        """Return the tile with which the base model is applied. Effects act on the whole field."""
        return self.base.tile if isinstance(self.base, Simulator) else None

    def forward(
        self,
        layout_um: Tensor,
        context: FieldContext | None = None,
        known: Fields | None = None,
        base_key: object = None,
    ) -> Tensor:
        """Return the predicted height, µm, of shape (b, 1, ny, nx). Without a context, the layout is taken as
        one whole write field.

        Args:
            known: cached fields after the base and after each effect that other chains have already computed
                for the same scan. Newly computed fields are added to it.
            base_key: value that identifies the base among the chains that share ``known``.
        """
        if context is None:
            assert isinstance(self.base, Simulator)
            geometry = self.base.config
            context = FieldContext(
                layout_um, geometry.pitch_um, geometry.full_height_um, geometry.level_height_um
            )
        known = {} if known is None else known
        exposed_um, key = self._applied("layout", layout_um, context, known, ())
        key = (*key, base_key)
        if key not in known:
            known[key] = self.base(exposed_um)
        return self._applied("height", known[key], context, known, key)[0]

    def _applied(
        self, acts_on: ActsOn, field: Tensor, context: FieldContext, known: Fields, key: Key
    ) -> tuple[Tensor, Key]:
        for name, values in self.values.items():
            effect = get_effect(name)
            if effect.acts_on == acts_on:
                key = (*key, name, *values.values())
                if key not in known:
                    usual = "scan" if effect.stage == "measurement" else "print"
                    scanned = self.frames.get(name, usual) == "scan"
                    known[key] = effect(field, values, context, scanned=scanned)
                field = known[key]
        return field, key
