"""List the models of the printer by name, register further models, and build models."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from pydantic import ValidationError

from litho_data.commands.settings import refused
from litho_data.foundation.errors import InputError, require_known, said, unknown_name
from litho_data.foundation.plugins import OPTION, foreign_sha256
from litho_models.models.baselines import Affine, AffineMtf, BlurTable, Identity, Linear
from litho_models.models.features import Features, RandomFeatures
from litho_models.models.fno import Fno
from litho_models.models.parts import REGISTERED, kernels_part, register_part
from litho_models.models.pbl import Pbl
from litho_models.models.physics import Physics
from litho_models.models.printers import DmdGrayscale, ElectronBeam, LaserWriter, Printer, Projection
from litho_models.simulator import Simulator, Variant

__all__ = [
    "MODELS",
    "build_model",
    "fixed_numbers",
    "kernels_part",
    "model_class",
    "register_part",
    "register_simulator",
    "registered_sources",
    "require_models",
]

MODELS: dict[str, type[Simulator]] = {
    model.name: model
    for model in (
        *(Identity, Affine, AffineMtf, BlurTable, Linear),
        *(Features, RandomFeatures, Physics, ElectronBeam, Projection, LaserWriter, DmdGrayscale, Pbl, Fno),
    )
}
# Side, in pixels, of the layout on which a registered model is tried. The crops on which models are trained
# have the same side.
_TRIAL_PX = 128
# Maps the name of each registered model to the hashes of the source code of its class and base classes.
_REGISTERED: dict[str, list[str]] = {}


def register_simulator(model: type[Simulator]) -> type[Simulator]:
    """Register a class of models. Every function and command in this Python process then accepts the name of
    the model.

    If a plug-in calls this function, the class is also registered in every process that a command starts.

    Raises:
        InputError: the class has no name, its name is already taken, or it lacks ``reach_px`` or
            ``interior``.
    """
    name = getattr(model, "name", "")
    if not name or name in MODELS:
        raise InputError("simulator to register", got=f"name {name!r}", wanted="a name that is not taken")
    if missing := ", ".join(sorted(model.__abstractmethods__)):
        raise InputError(f"simulator {name}", got=f"no {missing}", wanted="a class that defines it")
    MODELS[name] = model
    _REGISTERED[name] = [foreign_sha256(one) for one in model.__mro__ if one not in Simulator.__mro__]
    return model


def registered_sources(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return hashes of the registered class and the registered parts on which a model depends: its class, if
    it was registered, and those registered parts that ``settings`` names. If there are none, the returned
    dict is empty.
    """
    modular = issubclass(model_class(name), Printer)
    named = settings["parts"] if modular else [settings.get("illumination")]
    parts = {part: source for part, source in REGISTERED.items() if part in named}
    own = {"model_sources": _REGISTERED.get(name), "part_sources": parts}
    return {key: value for key, value in own.items() if value}


def model_class(name: str) -> type[Simulator]:
    """Return the class of the model with this name.

    Raises:
        InputError: the name is unknown.
    """
    if name not in MODELS:
        hint = f"a model of your own has to be registered first, in a command with {OPTION} FILE"
        raise unknown_name("model", name, MODELS, hint)
    return MODELS[name]


def require_models(names: Sequence[str]) -> None:
    """Check a list of model names that a user gave. If the list is not valid, raise an error.

    Raises:
        InputError: the list is empty or is a single string, or a name is repeated or unknown.
    """
    if isinstance(names, str):
        raise InputError("models", got=repr(names), wanted="a list of names", hint=f"use [{names!r}]")
    for name in names:
        model_class(name)
    if not names or len(set(names)) < len(names):
        raise InputError(
            "models", got=", ".join(names) or "none", wanted=f"one or more of {', '.join(MODELS)}, each once"
        )


def fixed_numbers(name: str, fix: Sequence[str] = (), free: Sequence[str] = ()) -> list[str]:
    """Return the names of those parameters of a model that stay fixed in every fit.

    These are the parameters that are fixed by default, plus the parameters in ``fix``, minus the parameters
    in ``free``.

    Raises:
        InputError: the model is unknown, or ``free`` names a parameter that is not fixed by default.
    """
    usual = model_class(name).Config.model_fields["fixed"].default
    for one in free:
        require_known(f"fixed parameter of {name}", one, usual)
    return [*dict.fromkeys(one for one in (*usual, *fix) if one not in free)]


def build_model(name: str, variant: Variant = "default", **fields: Any) -> Simulator:
    """Build an untrained model. ``fields`` are values for fields of the model's configuration, which are its
    geometry and its hyper-parameters.

    Raises:
        InputError: the model or a field is unknown; ``fixed`` names an unknown parameter or a parameter of a
            network inside the model; a value is not allowed; or a registered model does not predict a map of
            finite heights.
    """
    kind = model_class(name)
    for field in fields:
        if "." not in field or not issubclass(kind, Printer):
            require_known(f"setting of {name}", field, kind.Config.model_fields)
    try:
        model = kind(kind.Config.of_variant(variant, **fields))
    except ValidationError as error:
        raise refused(error) from None
    ranges, own = model.ranges, [key for key, _ in model.named_parameters(recurse=False)]
    numbers = [ranges[key].name if key in ranges else key for key in own]
    for fixed in model.config.fixed:
        if fixed not in numbers:
            what, hint = f"parameter of {name} to fix", "the weights inside networks are always fitted"
            raise unknown_name(what, fixed, numbers, hint)
    if name in _REGISTERED:
        _require_heights(model)
    return model


def _require_heights(model: Simulator) -> None:
    """Predict the print of a ramp that rises from level 0 to the highest level. If the prediction fails or is
    not a finite height for each pixel, raise an InputError that names the model.
    """
    side = model.tile.size_px if model.tile else _TRIAL_PX
    ramp = torch.linspace(0, model.config.full_height_um, side * side).reshape(1, 1, side, side)
    what = f"prediction of model {model.name}"
    # In training mode, the trial could change running means or use up random numbers.
    model.eval()
    try:
        with torch.no_grad():
            heights = model(ramp)
            shapes, finite = (tuple(heights.shape), tuple(ramp.shape)), bool(heights.isfinite().all())
    except Exception as error:
        raise InputError(what, got=f"{type(error).__name__}: {said(error)}", wanted="heights") from error
    if shapes[0] != shapes[1]:
        cut = f"interior must cut reach_px = {model.reach_px} pixels off each side" if model.reach_px else ""
        raise InputError(what, got=f"shape {shapes[0]}", wanted=f"{shapes[1]}, that of the layout", hint=cut)
    if not finite:
        raise InputError(what, got="NaN or infinity", wanted="finite heights")
    model.train()
