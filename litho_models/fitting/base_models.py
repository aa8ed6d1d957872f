"""Make the untrained base models (models of the printer without effects) that the closed loop corrects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from litho_models.models import build_model
from litho_models.simulator import Simulator

AUTO = "auto"
# Models from which the loop chooses one if the name is ``AUTO``. The search begins with the first, which has
# the same form as the Physics model of the paper.
_COMPETING = ("physics", "affine-mtf", "blur-table")
# Settings of base models that differ from the defaults of these models.
_USUAL = {"physics": {"spot": "round"}}


def base_models(
    base: str, geometry: Mapping[str, Any], fields: Mapping[str, Any] = {}
) -> dict[str, Simulator]:
    """Return the model with the given name, or several small models if the name is ``AUTO``. The result is
    keyed by name.

    Args:
        base: name of a model, or ``AUTO``.
        geometry: pitch, level height and number of levels of the layouts, keyed by name.
        fields: settings of the model, keyed by name.
    """
    return {
        name: build_model(name, **geometry, **{**_USUAL.get(name, {}), **fields})
        for name in (_COMPETING if base == AUTO else (base,))
    }
