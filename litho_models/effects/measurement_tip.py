"""Measurement: the tip of the microscope, whose flanks touch before its end does."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from litho_models.effects.effect import Effect, FieldContext, Parameter, Values

# Cubic interpolation half-way between four neighbours.
_MIDDLE = (-1 / 16, 9 / 16, 9 / 16, -1 / 16)
_SHARPEST_UM = 1e-3


def tip_dilation(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """max over u of H(x - u) - u² / 2R, the path of a paraboloid; H + R |grad H|² / 2 to first order."""
    radius = values["radius_um"]
    # The formula divides by the radius: a sharper tip is taken in proportion, down to none at all.
    blunt = radius.clamp(min=_SHARPEST_UM)
    # A paraboloid is the sum of two parabolas: the axes take their maxima one after the other.
    columns_done = _dilate_rows(height.transpose(-1, -2), blunt, context.pitch_um).transpose(-1, -2)
    dilated = _dilate_rows(columns_done, blunt, context.pitch_um)
    return height + radius / blunt * (dilated - height)


def _dilate_rows(height: Tensor, radius_um: Tensor, pitch_um: float) -> Tensor:
    """Dilation of rows (..., x) by a parabola; the surface is straight between half pixels.

    On a straight piece of slope s the tip touches at the distance R s from its axis, or at the end of
    the piece that is nearest to it.
    """
    step_um = pitch_um / 2
    fine = _with_middles(height)
    slopes = fine.diff(dim=-1) / step_um
    steepest = float(slopes.detach().abs().max())
    reach = min(math.ceil(float(radius_um.detach()) * steepest / step_um) + 1, fine.shape[-1])
    fine = functional.pad(fine, (reach, reach, 0, 0), mode="replicate")
    slopes = functional.pad(slopes, (reach, reach))
    last = 2 * (height.shape[-1] - 1)
    highest = height
    for offset in range(-reach, reach):
        piece = slice(reach + offset, reach + offset + last + 1, 2)
        near_um, far_um = offset * step_um, (offset + 1) * step_um
        slope = slopes[..., piece]
        touch_um = (radius_um * slope).clamp(near_um, far_um)
        tip = fine[..., piece] + slope * (touch_um - near_um) - touch_um**2 / (2 * radius_um)
        highest = torch.maximum(highest, tip)
    return highest


def _with_middles(rows: Tensor) -> Tensor:
    """(..., x) -> (..., 2x - 1): the values and, between them, the cubic through their neighbours."""
    size = rows.shape[-1]
    padded = torch.cat([rows[..., :1], rows, rows[..., -1:]], dim=-1)
    shifted = [padded[..., start : start + size - 1] for start in range(len(_MIDDLE))]
    middles = torch.tensordot(rows.new_tensor(_MIDDLE), torch.stack(shifted), dims=1)
    return torch.cat([torch.stack([rows[..., :-1], middles], dim=-1).flatten(-2), rows[..., -1:]], dim=-1)


EFFECTS = (
    Effect(
        name="tip-dilation",
        title="tip of finite radius widening tops",
        stage="measurement",
        role="measurement",
        acts_on="height",
        parameters={"radius_um": Parameter("µm", 0.0, 2.0, 0.04)},
        apply=tip_dilation,
        trials=({"radius_um": 0.04}, {"radius_um": 0.4}),
        source="dilation by a paraboloid; a worn tip is far blunter than a new one",
        separating="scan again with a new tip; scan a tip characteriser",
    ),
)
