"""Models of the printer, trained on a dataset, corrected by its residual, and frozen for design."""

from typing import TYPE_CHECKING

from litho_data.foundation.faces import lazy_face

if TYPE_CHECKING:
    from litho_models.frozen import zoo as zoo
    from litho_models.frozen.files import load_frozen as load_frozen
    from litho_models.frozen.files import save_frozen as save_frozen
    from litho_models.frozen.simulator import FrozenSimulator as FrozenSimulator

    __version__: str
else:
    __getattr__, __dir__ = lazy_face(
        __name__,
        {
            "FrozenSimulator": "litho_models.frozen.simulator",
            "load_frozen": "litho_models.frozen.files",
            "save_frozen": "litho_models.frozen.files",
            "zoo": "litho_models.frozen",
        },
    )

__all__ = ["FrozenSimulator", "__version__", "load_frozen", "save_frozen", "zoo"]
