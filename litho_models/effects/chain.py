"""Apply effects before and after a base model."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Literal

from torch import Tensor, nn

from litho_models.effects.effect import ActsOn, FieldContext
from litho_models.effects.registry import get_effect, in_forward_order
from litho_models.simulator import Simulator, Tile

# Whether an effect rotates with the print or with the scan.
Frame = Literal["scan", "print"]
# What a field depends on: the effects before it, with their values, and the base.
Key = tuple[object, ...]
Fields = MutableMapping[Key, Tensor]


class EffectChain(nn.Module):
    """Apply layout effects, then the base model, then height effects, in the order of the catalogue.

    Args:
        base: a simulator, layout (b, 1, y, x) µm -> height (b, 1, y, x) µm.
        effects: parameter values by the name of the effect; parameters that are not given are off.
        frames: for height effects that deviate from the default, whether they rotate with the print or with
            the scan. By default, effects of stage ``measurement`` rotate with the scan, and all others rotate
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
        """Return the tile of the base model; effects act on the whole field."""
        return self.base.tile if isinstance(self.base, Simulator) else None

    def forward(
        self,
        layout_um: Tensor,
        context: FieldContext | None = None,
        known: Fields | None = None,
        base_key: object = None,
    ) -> Tensor:
        """Return the height (b, 1, y, x), µm. Without a context, the layout is taken as one write field.

        Args:
            known: fields after the base and after each effect, as far as they were already computed for the
                same scan; newly computed fields are added.
            base_key: identifies the base among the chains that share ``known``.
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
