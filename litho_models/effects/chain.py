"""A base model with effects at their stages, and the part of it that design may use."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor, nn

from litho_models.effects.effect import Effect, FieldContext
from litho_models.effects.registry import get_effect, in_forward_order
from litho_models.simulator import Simulator, Tile


class EffectChain(nn.Module):
    """Layout effects, the base model, then height effects, in the order of the catalogue.

    Args:
        base: a simulator, layout (b, 1, y, x) µm -> height (b, 1, y, x) µm.
        effects: effect name to parameter values; parameters not named are off.
        full_height_um: nominal height of the highest level, µm.
        pitch_um: lateral sampling, µm.
        scan_frame: height effects that act as the microscope's do, whatever the catalogue says: turned with
            the scan. Those of the stage ``measurement`` do,
        print_frame: but for these, which keep to the print.
    """

    def __init__(
        self,
        base: nn.Module,
        effects: Mapping[str, Mapping[str, float]],
        *,
        full_height_um: float,
        pitch_um: float,
        scan_frame: Collection[str] = (),
        print_frame: Collection[str] = (),
    ):
        super().__init__()
        self.base = base
        self.full_height_um = full_height_um
        self.pitch_um = pitch_um
        self.scan_frame = frozenset(scan_frame)
        self.print_frame = frozenset(print_frame)
        self.names = tuple(in_forward_order(list(effects)))
        for name in self.names:
            effect = get_effect(name)
            for parameter, value in effect.with_values(effects[name]).items():
                tensor = torch.tensor(float(value))
                if effect.parameters[parameter].kind == "choice":
                    self.register_buffer(_key(name, parameter), tensor)
                else:
                    self.register_parameter(_key(name, parameter), nn.Parameter(tensor))

    @property
    def tile(self) -> Tile | None:
        """The tile of the base model; the effects act on the whole field."""
        return self.base.tile if isinstance(self.base, Simulator) else None

    def forward(self, layout_um: Tensor, context: FieldContext | None = None) -> Tensor:
        """Height (b, 1, y, x), µm; without a context the field is a write field of its own."""
        context = context or FieldContext(layout_um, self.pitch_um, self.full_height_um)
        return self.after_base(self.base(self.before_base(layout_um, context)), context)

    def before_base(self, layout_um: Tensor, context: FieldContext) -> Tensor:
        """The layout as the base model gets it."""
        return self._run_stage("layout", layout_um, context)

    def after_base(self, height_um: Tensor, context: FieldContext) -> Tensor:
        """The base model's height with the height effects."""
        return self._run_stage("height", height_um, context)

    def values(self) -> dict[str, dict[str, float]]:
        """Parameter values of all effects as numbers."""
        return {
            name: {key: float(one.detach()) for key, one in self._tensors(get_effect(name)).items()}
            for name in self.names
        }

    def _run_stage(self, acts_on: str, field: Tensor, context: FieldContext) -> Tensor:
        for name in self.names:
            effect = get_effect(name)
            if effect.acts_on == acts_on:
                turns = effect.stage == "measurement" or name in self.scan_frame
                apply = effect.as_scanned if turns and name not in self.print_frame else effect.apply
                field = apply(field, self._tensors(effect), context)
        return field

    def _tensors(self, effect: Effect) -> dict[str, Tensor]:
        return {parameter: getattr(self, _key(effect.name, parameter)) for parameter in effect.parameters}


def _key(name: str, parameter: str) -> str:
    return f"{name.replace('-', '_')}__{parameter}"
