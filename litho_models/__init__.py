"""Models of the printer, trained on a dataset, corrected by its residual, and frozen for design."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from litho_models.frozen import zoo
    from litho_models.frozen.files import load_frozen, save_frozen
    from litho_models.frozen.simulator import FrozenSimulator

__all__ = ["FrozenSimulator", "load_frozen", "save_frozen", "zoo"]


def __getattr__(name: str) -> Any:
    """Load torch only when a model is asked for."""
    if name == "zoo":
        return importlib.import_module("litho_models.frozen.zoo")
    if name == "FrozenSimulator":
        return importlib.import_module("litho_models.frozen.simulator").FrozenSimulator
    if name in __all__:
        return getattr(importlib.import_module("litho_models.frozen.files"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
