"""All models by name."""

from collections.abc import Sequence
from typing import Any

from litho_data.foundation.errors import InputError, require_known
from litho_models.models.baselines import Affine, AffineMtf, BlurTable, Identity, Linear
from litho_models.models.electron_beam import ElectronBeam
from litho_models.models.features import Features, RandomFeatures
from litho_models.models.fno import Fno
from litho_models.models.pbl import Pbl
from litho_models.models.physics import Physics
from litho_models.simulator import Simulator, Variant

__all__ = ["MODELS", "build_model", "model_class", "register_simulator", "require_models"]

MODELS: dict[str, type[Simulator]] = {
    model.name: model
    for model in (
        *(Identity, Affine, AffineMtf, BlurTable, Linear),
        *(Features, RandomFeatures, Physics, ElectronBeam, Pbl, Fno),
    )
}


def register_simulator(model: type[Simulator]) -> type[Simulator]:
    """Take a model by its name from now on, in every function and command of this process.

    To work in several processes, call this in a module that every process imports.

    Raises:
        InputError: no name of its own, or one that is taken.
    """
    name = getattr(model, "name", "")
    if not name or name in MODELS:
        raise InputError("simulator to register", got=f"name {name!r}", wanted="a name that is not taken")
    MODELS[name] = model
    return model


def model_class(name: str) -> type[Simulator]:
    """The class of a model name.

    Raises:
        InputError: unknown name.
    """
    require_known("model", name, MODELS)
    return MODELS[name]


def require_models(names: Sequence[str]) -> None:
    """Check a list of model names, as a user gives one.

    Raises:
        InputError: no name, one twice, or an unknown one.
    """
    if isinstance(names, str):
        raise InputError("models", got=repr(names), wanted="a list of names", hint=f"such as [{names!r}]")
    for name in names:
        model_class(name)
    if not names or len(set(names)) < len(names):
        raise InputError(
            "models", got=", ".join(names) or "none", wanted=f"one or more of {', '.join(MODELS)}, each once"
        )


def build_model(name: str, variant: Variant = "default", **fields: Any) -> Simulator:
    """An untrained model; ``fields`` are config fields (geometry, hyper-parameters)."""
    model = model_class(name)
    return model(model.Config.of_variant(variant, **fields))
