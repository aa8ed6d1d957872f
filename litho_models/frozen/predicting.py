"""Printed heights for layouts as people hold them: arrays of three kinds, of two dimensions or more."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from litho_data.foundation.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

Field = TypeVar("Field", np.ndarray, "xr.DataArray", Tensor)


def predict_layout(model: nn.Module, layout_um: Field, *, pitch_um: float, level_height_um: float) -> Field:
    """What ``FrozenSimulator.predict`` promises, of a model of that pitch and level height."""
    if isinstance(layout_um, Tensor):
        return _predict_tensor(model, layout_um, level_height_um)
    if isinstance(layout_um, np.ndarray):
        device = next(model.parameters(), torch.empty(0)).device
        with torch.no_grad():
            layout = torch.as_tensor(layout_um, device=device)
            return _predict_tensor(model, layout, level_height_um).cpu().numpy()
    import xarray as xr

    if not isinstance(layout_um, xr.DataArray):
        kinds = "an array of NumPy or xarray, or a tensor"
        raise InputError("layout", got=f"a {type(layout_um).__name__}", wanted=kinds)
    _check_sampling(layout_um, pitch_um)
    height = predict_layout(model, layout_um.to_numpy(), pitch_um=pitch_um, level_height_um=level_height_um)
    printed = layout_um.copy(data=height).rename("height_um")
    return printed.assign_attrs(units="µm", long_name="printed height")


def _predict_tensor(model: nn.Module, layout_um: Tensor, level_height_um: float) -> Tensor:
    if not layout_um.is_floating_point():
        raise InputError(
            "layout",
            got="whole numbers",
            wanted="heights in µm",
            hint=f"levels * {level_height_um:g} are heights",
        )
    if layout_um.ndim < 2 or not layout_um.numel():
        shape = tuple(layout_um.shape)
        raise InputError("layout", got=f"shape {shape}", wanted="(..., y, x), none of them 0")
    dtype = next((weight.dtype for weight in model.parameters()), layout_um.dtype)
    fields = layout_um.to(dtype).reshape(-1, 1, 1, *layout_um.shape[-2:])
    # One after the other: a stack takes the memory of one field.
    return torch.cat([model(field) for field in fields]).reshape(layout_um.shape)


def _check_sampling(layout_um: xr.DataArray, pitch_um: float) -> None:
    if layout_um.dims[-2:] != ("y", "x"):
        raise InputError("layout", got=f"dimensions {layout_um.dims}", wanted="(..., 'y', 'x')")
    for name in ("y_um", "x_um"):
        if name in layout_um.coords:
            steps = np.diff(layout_um[name].to_numpy())
            # A millionth of a pixel: rounding of positions across a millimetre.
            if not np.allclose(steps, pitch_um, rtol=1e-6, atol=0):
                got = f"steps of {steps.min():g} to {steps.max():g} µm"
                raise InputError(f"{name} of the layout", got=got, wanted=f"{pitch_um:g} µm")
