"""Printed heights for layouts as people hold them: arrays of three kinds, or a file of levels."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.level.scan import write_heights
from litho_data.readers.layout import read_layout

if TYPE_CHECKING:
    import xarray as xr

    from litho_models.frozen.simulator import FrozenSimulator

Field = TypeVar("Field", np.ndarray, "xr.DataArray", Tensor)


def predict_layout(model: FrozenSimulator, layout_um: Field) -> Field:
    """What ``FrozenSimulator.predict`` promises."""
    if isinstance(layout_um, Tensor):
        return _predict_tensor(model, layout_um)
    if isinstance(layout_um, np.ndarray):
        device = next(model.parameters(), torch.empty(0)).device
        with torch.no_grad():
            return _predict_tensor(model, torch.as_tensor(layout_um, device=device)).cpu().numpy()
    import xarray as xr

    if not isinstance(layout_um, xr.DataArray):
        kinds = "an array of NumPy or xarray, or a tensor"
        raise InputError("layout", got=f"a {type(layout_um).__name__}", wanted=kinds)
    _check_sampling(model, layout_um)
    height = layout_um.copy(data=predict_layout(model, layout_um.to_numpy())).rename("height_um")
    return height.assign_attrs(units="µm", long_name="printed height")


def predict_file(model: FrozenSimulator, layout: str | Path, out: str | Path) -> np.ndarray:
    """Predict the print of a layout of levels and write its height to ``out``; returns it, (ny, nx) µm.

    Args:
        model: a frozen model.
        layout: TIFF, PNG, BMP or NPY of integer levels, sampled at the model's pitch.
        out: a ``.gsf`` (opens in Gwyddion) or ``.npy`` file.

    Raises:
        InputError: a layout that cannot be read or has levels beyond the calibrated range, or another suffix.
    """
    step_um, pitch_um = model.card["level_height_um"], model.pitch_um
    height = predict_layout(model, read_layout(layout).astype(np.float32) * np.float32(step_um))
    write_heights(out, height, pitch_um=(pitch_um, pitch_um), title=f"{Path(layout).name} by {model.name}")
    return height


def _predict_tensor(model: FrozenSimulator, layout_um: Tensor) -> Tensor:
    if not layout_um.is_floating_point():
        raise InputError(
            "layout",
            got="whole numbers",
            wanted="heights in µm",
            hint=f"levels * {model.card['level_height_um']:g} are heights",
        )
    if layout_um.ndim < 2 or not layout_um.numel():
        shape = tuple(layout_um.shape)
        raise InputError("layout", got=f"shape {shape}", wanted="(..., y, x), none of them 0")
    dtype = next((weight.dtype for weight in model.parameters()), layout_um.dtype)
    fields = layout_um.to(dtype).reshape(-1, 1, 1, *layout_um.shape[-2:])
    # One after the other: a stack takes the memory of one field.
    return torch.cat([model(field) for field in fields]).reshape(layout_um.shape)


def _check_sampling(model: FrozenSimulator, layout_um: xr.DataArray) -> None:
    if layout_um.dims[-2:] != ("y", "x"):
        raise InputError("layout", got=f"dimensions {layout_um.dims}", wanted="(..., 'y', 'x')")
    for name in ("y_um", "x_um"):
        if name in layout_um.coords:
            steps = np.diff(layout_um[name].to_numpy())
            # A millionth of a pixel: rounding of positions across a millimetre.
            if not np.allclose(steps, model.pitch_um, rtol=1e-6, atol=0):
                got = f"steps of {steps.min():g} to {steps.max():g} µm"
                raise InputError(f"{name} of the layout", got=got, wanted=f"{model.pitch_um:g} µm")
