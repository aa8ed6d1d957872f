"""Exposure: what depends on the place in the write field or in the writing order."""

from __future__ import annotations

import torch
from torch import Tensor

from litho_models.effects.effect import Effect, FieldContext, Parameter, Values, of_exposure
from litho_models.effects.filters import add_blur


def vignetting(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """D = M (1 - v r² / R²): less light towards the edge of the write field."""
    y, x = context.centred_um()
    return layout * (1 - values["strength"] * (y * y + x * x) / context.radius_um() ** 2)


def field_curvature(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H + 1[M > 0] (a x + b y + c r²), coordinates in units of R: focus and stage tilt over the field."""
    y, x = context.centred_um()
    radius = context.radius_um()
    surface = (
        values["tilt_x_um"] * x / radius
        + values["tilt_y_um"] * y / radius
        + values["curvature_um"] * (x * x + y * y) / radius**2
    )
    return height + (context.layout_um > 0).to(height.dtype) * surface


def laser_drift(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """D = M (1 + ρ t), t the place in the writing order from -0.5 to 0.5."""
    return layout * (1 + values["drift"] * context.order)


def interface_offset(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """max(H - z, H_s) where H > H_s, the substrate: writing starts below it, and that part is lost.

    The part would have shrunk like the rest, z = z0 (1 - k (1 - u)), u the relative nominal height nearby.
    """
    substrate_um, length = values["substrate_um"], values["length_um"]
    relative = context.layout_um / context.full_height_um
    dose = add_blur(relative, length**2, context.pitch_um, 3 * float(length.detach()))
    lost_um = values["depth_um"] * (1 - values["shrinkage"] * (1 - dose))
    return torch.where(height > substrate_um, torch.maximum(height - lost_um, substrate_um), height)


EFFECTS = (
    of_exposure(
        name="vignetting",
        title="dose falling towards the edge of the write field",
        parameters={"strength": Parameter("1", 0.0, 0.6, 0.1)},
        apply=vignetting,
        trials=({"strength": 0.1},),
        source="aperture of scanning objectives; quadratic in the field radius",
        separating="print one layout at the centre and at the edge of the write field",
    ),
    Effect(
        name="field-curvature",
        title="focus surface tilted or curved over the write field",
        stage="exposure",
        role="process",
        acts_on="height",
        parameters={
            "tilt_x_um": Parameter("µm", -0.6, 0.6, 0.05),
            "tilt_y_um": Parameter("µm", -0.6, 0.6, 0.05),
            "curvature_um": Parameter("µm", -0.6, 0.6, 0.05),
        },
        apply=field_curvature,
        trials=({"tilt_x_um": 0.05}, {"tilt_y_um": 0.05}, {"curvature_um": 0.05}),
        source="Ellingen 2023, JOM 3(4) 043501",
        separating="leave bare substrate in every field as a reference for the levelling",
    ),
    Effect(
        name="laser-drift",
        title="laser power drifting while the set is written",
        stage="exposure",
        role="nuisance",
        acts_on="layout",
        parameters={"drift": Parameter("1 over the set", -0.5, 0.5, 0.1)},
        apply=laser_drift,
        trials=({"drift": 0.1},),
        source="linear in the writing order",
        separating="repeat one layout at the start, the middle and the end of the set; log the laser power",
        needs=("order",),
    ),
    Effect(
        name="interface-offset",
        title="writing started below the surface of the substrate",
        stage="exposure",
        role="process",
        acts_on="height",
        parameters={
            "depth_um": Parameter("µm", 0.0, 0.8, 0.1),
            "substrate_um": Parameter("µm", -0.3, 0.5, 0.05, kind="shape"),
            "shrinkage": Parameter("1", 0.0, 0.9, 0.3, kind="shape"),
            "length_um": Parameter("µm", 0.3, 3.0, 1.5, kind="shape"),
        },
        apply=interface_offset,
        trials=tuple({"depth_um": depth} for depth in (0.05, 0.15, 0.3)),
        source="search of the interface before writing; clipping at the substrate",
        separating="leave bare substrate in every field",
    ),
)
