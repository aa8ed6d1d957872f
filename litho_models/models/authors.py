"""Load weights that were trained with the published code of the authors of Neural Lithography
(arXiv:2309.17343), and use them in the models of variant ``authors``. Each weight has a name in the authors'
code and is renamed to its name in this package.

Source: Neural-Litho/Neural_Lithography at e97f907 (Apache-2.0).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_models.layers.ranges import Range
from litho_models.models.fno import Fno
from litho_models.models.pbl import Pbl
from litho_models.models.physics import Physics
from litho_models.simulator import Simulator

_PHYSICS = {
    "sigmac_param": "tau",
    "thresh": "raw_eta",
    "alpha": "raw_alpha",
    "kmin": "raw_kappa_min",
    "height_bias": "bias_um",
}


def model_of_authors(weights: Mapping[str, Any], **fields: Any) -> Simulator:
    """Return a PBL, Physics or FNO model of variant ``authors`` with the weights of the corresponding class
    in the authors' code.

    Args:
        weights: ``state_dict`` of the authors' model, a mapping from name to array or tensor. Complex weights
            may also be given as pairs of real numbers along the last axis.
        fields: values for fields of the model's configuration, such as its geometry.

    Raises:
        InputError: the weights do not belong to any of the three classes, or some weights are missing,
            unknown or of the wrong size.
    """
    if not isinstance(weights, Mapping):
        hint = "read the authors' file with torch.load"
        raise InputError("weights", got=type(weights).__name__, wanted="a state_dict", hint=hint)
    own = {name: _as_real(value) for name, value in weights.items()}
    model: Simulator
    if "fc0.weight" in own:
        model = Fno(Fno.Config.of_variant("authors", **{"width": own["fc0.weight"].shape[0], **fields}))
        state = _fno_state(own)
    elif "height_bias" in own:
        model = Physics(Physics.Config.of_variant("authors", **fields))
        state = _physics_state(own, model.ranges["raw_alpha"])
    elif "sigmac_param" in own:
        model = Pbl(Pbl.Config.of_variant("authors", **fields))
        state = _pbl_state(own)
    else:
        raise InputError(
            "weights", got=", ".join(own) or "none", wanted="the weights of one of the authors' classes"
        )
    wanted = model.state_dict()
    wrong = sorted(
        name
        for name in wanted.keys() | state.keys()
        if name not in wanted or name not in state or wanted[name].numel() != state[name].numel()
    )
    if wrong:
        raise InputError(
            f"weights of the authors' {model.name}",
            got=f"missing, unknown or of another size: {', '.join(wrong)}",
            wanted="the complete state_dict",
        )
    # The models here store 1 x 1 convolutions as matrices and tensors of shape (1,) as scalars.
    model.load_state_dict({name: state[name].reshape(wanted[name].shape) for name in wanted})
    return model.eval()


def _physics_state(own: Mapping[str, Tensor], steepness: Range) -> dict[str, Tensor]:
    state = {_PHYSICS.get(name, name): value for name, value in own.items()}
    if "raw_alpha" in state:
        alpha = float(state["raw_alpha"])
        if not alpha > 0:
            raise InputError("alpha of the authors' physics", got=alpha, wanted="a number above 0")
        # In the authors' code, the parameter is the steepness itself. Here it is the raw number that
        # corresponds to the steepness (see ``layers.ranges``).
        state["raw_alpha"] = steepness.raw(alpha)
    return state


def _pbl_state(own: Mapping[str, Tensor]) -> dict[str, Tensor]:
    names = {"sigmac_param": "tau"}
    for kind in ("weight", "bias"):
        for part in ("thresh", "shrink"):
            names |= {f"{part}_approx.conv{i}.{kind}": f"{part}.layers.{2 * i}.{kind}" for i in range(3)}
        names |= {f"out_layer.conv{i}.{kind}": f"mismatch.hidden.{i}.{kind}" for i in range(4)}
        names[f"out_layer.conv4.{kind}"] = f"mismatch.last.{kind}"
    return {names.get(name, name): value for name, value in own.items()}


def _fno_state(own: Mapping[str, Tensor]) -> dict[str, Tensor]:
    names: dict[str, str] = {}
    for kind in ("weight", "bias"):
        names |= {
            f"{a}.{kind}": f"{b}.{kind}" for a, b in (("fc0", "lift"), ("fc1", "hidden"), ("fc2", "last"))
        }
        names |= {f"w{i}.{kind}": f"local.{i}.{kind}" for i in range(4)}
    state = {names.get(name, name): value for name, value in own.items()}
    for i in range(4):
        # Here, one parameter contains the matrices for both signs of the frequency along y.
        signs = [state.pop(f"conv{i}.weights{sign}", None) for sign in (1, 2)]
        pair = [matrix for matrix in signs if matrix is not None]
        if len(pair) == 2 and pair[0].shape == pair[1].shape:
            state[f"spectral.{i}.weight"] = torch.stack(pair)
    return state


def _as_real(value: Any) -> Tensor:
    tensor = value.detach() if isinstance(value, Tensor) else torch.from_numpy(np.asarray(value))
    return (torch.view_as_real(tensor) if tensor.is_complex() else tensor).float()
