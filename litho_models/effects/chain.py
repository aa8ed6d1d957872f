"""Apply effects before and after a base model."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Literal

import torch
from torch import Tensor, nn

from litho_models.effects.effect import ActsOn, FieldContext
from litho_models.effects.registry import get_effect, in_forward_order
from litho_models.simulator import Simulator, Tile

# The frame of an effect: whether the effect rotates with the print or with the scan.
Frame = Literal["scan", "print"]
# Key of a cached field. It contains everything on which the field depends: the base model, and the names,
# frames and parameter values of the effects applied so far.
Key = tuple[object, ...]
Fields = MutableMapping[Key, Tensor]


class EffectChain(nn.Module):
    """Apply the effects that change the layout, then the base model, then the effects that change the height.
    Within each of the two groups, the effects are applied in the order of the catalogue.

    Args:
        base: a simulator that maps a layout in µm to a height in µm. Both tensors have shape (b, 1, ny, nx).
        effects: parameter values of each effect, keyed by the name of the effect. A parameter that is not
            given is set to its value ``Parameter.off``.
        frames: frame of each effect, keyed by the name of the effect: ``print`` if the effect rotates with
            the print, and ``scan`` if it rotates with the scan. By default, effects of stage ``measurement``
            rotate with the scan, and all others rotate with the print.
    """

    def __init__(
        self,
        base: nn.Module,
        effects: Mapping[str, Mapping[str, float]],
        frames: Mapping[str, Frame] = {},
    ):
        super().__init__()
        self.base = base
        self.frames = frames
        self.values = {
            name: get_effect(name).with_values(effects[name]) for name in in_forward_order(effects)
        }

    @property
    def tile(self) -> Tile | None:
        """Return the size of the tiles to which the base model is applied. (Effects are applied to the whole
        field.)
        """
        return self.base.tile if isinstance(self.base, Simulator) else None

    def forward(
        self,
        layout_um: Tensor,
        context: FieldContext | None = None,
        known: Fields | None = None,
        base_key: object = None,
    ) -> Tensor:
        """Return the predicted height, µm, of shape (b, 1, ny, nx). If no context is given, each layout is
        assumed to fill the whole write field.

        Args:
            context: information about the scan to predict. If it is given, the batch must contain only one
                layout.
            known: cache of intermediate fields that this chain or other chains have already computed for the
                same scan: the outputs of the base and of the effects. Newly computed fields are added to this
                cache.
            base_key: value that identifies the base if chains with different bases share the cache ``known``.
        """
        if context is None:
            if len(layout_um) > 1:
                # A context describes a single field, and so do the formulas of many effects.
                return torch.cat([self(one) for one in layout_um.split(1)])
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
                usual = "scan" if effect.stage == "measurement" else "print"
                scanned = self.frames.get(name, usual) == "scan"
                key = (*key, name, scanned, *values.values())
                if key not in known:
                    known[key] = effect(field, values, context, scanned=scanned)
                field = known[key]
        return field, key
