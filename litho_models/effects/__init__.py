"""The catalogue of effects. An effect is a named, differentiable change of the layout or of the height. Every
effect can be switched off.
"""

from litho_models.effects.effect import Effect, FieldContext, Parameter, of_single_scans
from litho_models.effects.registry import (
    CATALOGUE,
    UNTESTABLE,
    get_effect,
    in_forward_order,
    register_effect,
    screened_effects,
)

__all__ = [
    "CATALOGUE",
    "UNTESTABLE",
    "Effect",
    "FieldContext",
    "Parameter",
    "get_effect",
    "in_forward_order",
    "of_single_scans",
    "register_effect",
    "screened_effects",
]
