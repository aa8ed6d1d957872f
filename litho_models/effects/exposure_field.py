"""Exposure: what depends on the place in the write field or in the writing order."""

from __future__ import annotations

import torch
from torch import Tensor

from litho_models.effects.effect import FieldContext, Parameter, Values, of_exposure
from litho_models.effects.filters import dose_nearby


@of_exposure(
    "dose falling towards the edge of the write field",
    {"strength": Parameter("1", 0.0, 0.6, 0.1)},
    source="aperture of scanning objectives; quadratic in the field radius",
    separating="print one layout at the centre and at the edge of the write field",
)
def vignetting(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """D = M (1 - v r² / R²): less light towards the edge of the write field."""
    y, x = context.centred_um()
    return layout * (1 - values["strength"] * (y * y + x * x) / context.radius_um() ** 2)


@of_exposure(
    "focus surface tilted or curved over the write field",
    {name: Parameter("µm", -0.6, 0.6, 0.05) for name in ("tilt_x_um", "tilt_y_um", "curvature_um")},
    acts_on="height",
    source="Ellingen 2023, JOM 3(4) 043501",
    separating="leave bare substrate in every field as a reference for the levelling",
)
def field_curvature(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H + 1[M > 0] (a x + b y + c r²), coordinates in units of R: focus and stage tilt over the field."""
    y, x = context.centred_um()
    radius = context.radius_um()
    tilt = values["tilt_x_um"] * x / radius + values["tilt_y_um"] * y / radius
    surface = tilt + values["curvature_um"] * (x * x + y * y) / radius**2
    return height + (context.layout_um > 0).to(height.dtype) * surface


@of_exposure(
    "laser power drifting while the set is written",
    {"drift": Parameter("1 over the set", -0.5, 0.5, 0.1)},
    role="nuisance",
    source="linear in the writing order",
    separating="repeat one layout at the start, the middle and the end of the set; log the laser power",
    needs=("order",),
)
def laser_drift(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """D = M (1 + ρ t), t the place in the writing order from -0.5 to 0.5."""
    return layout * (1 + values["drift"] * context.order)


@of_exposure(
    "writing started below the surface of the substrate",
    {
        "depth_um": Parameter("µm", 0.0, 0.8, 0.1, tried=(0.05, 0.15, 0.3)),
        "substrate_um": Parameter("µm", -0.3, 0.5, 0.05, "shape"),
        "shrinkage": Parameter("1", 0.0, 0.9, 0.3, "shape"),
        "length_um": Parameter("µm", 0.3, 3.0, 1.5, "shape"),
    },
    acts_on="height",
    source="search of the interface before writing; clipping at the substrate",
    separating="leave bare substrate in every field",
)
def interface_offset(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """max(H - z, H_s) where H > H_s, the substrate: writing starts below it, and that part is lost.

    The part would have shrunk like the rest, z = z0 (1 - k (1 - u)), u the relative nominal height nearby.
    """
    substrate_um = values["substrate_um"]
    thinned = values["shrinkage"] * (1 - dose_nearby(context, values["length_um"]))
    lost_um = values["depth_um"] * (1 - thinned)
    return torch.where(height > substrate_um, torch.maximum(height - lost_um, substrate_um), height)
