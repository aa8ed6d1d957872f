"""Exposure: heights are written as a stack of slices, each of which has to set on its own."""

from __future__ import annotations

import torch
from torch import Tensor

from litho_models.effects.effect import Effect, FieldContext, Parameter, Values
from litho_models.effects.filters import add_blur

_SPOT_VARIANCE_UM2 = 0.02
_SPOT_REACH_UM = 0.8


def layer_stacking(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """(1 - w) G*M + w Σ t·step(G * 1[M >= k t]), as a change of M: slices of height t set one by one.

    The step is logistic about the threshold and maps 0 to 0 and 1 to 1: a slice narrower than the
    spot is lost, a gap narrower than it is filled, which a column of many slices would average out.
    """
    layout = context.layout_um
    count = max(1, round(context.full_height_um / context.slice_um))
    slices = torch.clamp(layout / context.slice_um - torch.arange(count).to(layout)[:, None, None], 0, 1)
    variance = torch.as_tensor(_SPOT_VARIANCE_UM2, dtype=layout.dtype, device=layout.device)
    exposed = add_blur(
        slices.reshape(count, 1, *layout.shape[-2:]), variance, context.pitch_um, _SPOT_REACH_UM
    )
    gained = _step(exposed, values["threshold"], values["steepness"]) - exposed
    return height + values["share"] * context.slice_um * gained.sum(dim=0, keepdim=True)


def _step(dose: Tensor, threshold: Tensor, steepness: Tensor) -> Tensor:
    low, high = (torch.sigmoid(steepness * (edge - threshold)) for edge in (0.0, 1.0))
    return (torch.sigmoid(steepness * (dose - threshold)) - low) / (high - low)


EFFECTS = (
    Effect(
        name="layer-stacking",
        title="slices setting one by one",
        stage="exposure",
        role="process",
        acts_on="height",
        parameters={
            "share": Parameter("1", 0.0, 1.0, 0.3),
            "threshold": Parameter("1", 0.2, 0.8, 0.5, kind="shape"),
            "steepness": Parameter("1", 4.0, 40.0, 12.0, kind="shape"),
        },
        apply=layer_stacking,
        trials=tuple(
            {"share": 0.3, "threshold": threshold, "steepness": 12.0} for threshold in (0.35, 0.5, 0.65)
        ),
        source="slicing of the paper, 0.1 µm; threshold per slice",
        separating="pillars and pits of one width and several heights, one slice and many",
    ),
)
