"""Effects of the exposure that depend on the position in the write field, the writing order or the motion of
the beam.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from litho_models.effects.effect import ALONG_AXES, DIRECTION, FieldContext, Parameter, Values, of_exposure
from litho_models.effects.filters import add_filtered, add_warp, gradient, trailing_response

_TAIL_LENGTHS = 6
# Lowest frequency of a ripple. Ripples of lower frequency cannot be distinguished from smooth changes over
# the field.
_SLOWEST_PER_UM = 0.19
_RIPPLES_PER_UM = tuple(round(0.2 + 0.02 * i, 2) for i in range(21))


@of_exposure(
    "dose falling towards the edge of the write field",
    {"strength": Parameter("1", 0.0, 0.6, 0.1)},
    separating="print one layout at the centre and at the edge of the write field",
)
def vignetting(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Reduce the dose towards the edge of the write field: D = M (1 - v r² / R²), where r is the distance
    from the centre of the write field and R is half the width of the write field.

    The aperture of the objective cuts off light, in proportion to the squared distance from the axis.
    """
    y, x = context.centred_um()
    return layout * (1 - values["strength"] * (y * y + x * x) / context.radius_um() ** 2)


@of_exposure(
    "focus surface tilted or curved over the write field",
    {name: Parameter("µm", -0.6, 0.6, 0.05) for name in ("tilt_x_um", "tilt_y_um", "curvature_um")},
    acts_on="height",
    separating="leave bare substrate in every field as a reference for the levelling",
)
def field_curvature(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Add the height changes caused by a focus surface that is tilted or curved over the write field:
    H + 1[M > 0] (a x + b y + c r²). The coordinates x, y and r are in units of R, half the width of the write
    field.

    Source: Ellingen 2023, JOM 3(4) 043501.
    """
    y, x = (place / context.radius_um() for place in context.centred_um())
    tilt = values["tilt_x_um"] * x + values["tilt_y_um"] * y
    surface = tilt + values["curvature_um"] * (x * x + y * y)
    return height + (context.layout_um > 0) * surface


@of_exposure(
    "laser power drifting while the set is written",
    {"drift": Parameter("1 over the set", -0.5, 0.5, 0.1)},
    role="nuisance",
    separating="repeat one layout at the start, the middle and the end of the set; log the laser power",
    needs=("order",),
)
def laser_drift(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Let the dose drift from field to field: D = M (1 + ρ t), where ρ is the relative drift over all fields
    and t is the position of the field in the writing order, from -0.5 to 0.5.

    The drift is linear in the writing order.
    """
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
    separating="leave bare substrate in every field",
)
def interface_offset(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Remove the part of the print that was written below the surface H_s of the substrate: max(H - z, H_s)
    where H > H_s.

    The removed part has height z, and it shrinks like the rest of the print: z = z0 (1 - k (1 - u)). Here z0
    is the depth at which writing started, measured from the surface of the substrate, and u is the mean
    nominal height nearby as a fraction of the full height.

    The printer searches for the interface before writing. Heights are clipped at the substrate.
    """
    substrate_um = values["substrate_um"]
    lost_um = values["depth_um"] * context.left_by_shrinkage(values["shrinkage"], values["length_um"])
    return torch.where(height > substrate_um, torch.maximum(height - lost_um, substrate_um), height)


@of_exposure(
    "beam lagging behind the scan command along the written lines",
    {
        "length_um": Parameter("µm", 0.0, 1.5, 0.2, tried=(0.15, 0.4)),
        "direction": DIRECTION,
    },
    separating="print the same layout at 0 and 90 degrees, scan both at 0 and 90 degrees",
)
def galvo_lag(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Let the beam lag behind the commanded position: filter the layout along the written lines with a
    one-sided exponential of length l = v τ (speed times time constant). The mean delay l of this filter is
    removed, because registration removes every mean shift.

    The deflection has a first-order lag: l is the speed times the time constant.
    """
    length, direction, pitch = values["length_um"], values["direction"], context.pitch_um

    def transfer_minus_one(fy: Tensor, fx: Tensor) -> Tensor:
        along = direction * (fx if context.slow_axis == "y" else fy)
        return trailing_response(along, length, pitch) * torch.exp(2j * math.pi * along * length) - 1

    return add_filtered(layout, transfer_minus_one, pitch, _TAIL_LENGTHS * float(length.detach()) + pitch)


@of_exposure(
    "written lines that begin and end too late",
    {axis: Parameter("µm", -0.6, 0.6, 0.1) for axis in ("along_x_um", "along_y_um")},
    trials=ALONG_AXES,
    separating="straight edges of several steepnesses, printed and scanned at 0 and 90 degrees",
)
def line_shortening(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Shorten every written line by δ at both ends (δ < 0 lengthens it): M - δx |∂M/∂x| - δy |∂M/∂y|.

    At an edge, the formula removes the correct area, but gives the edge a wrong profile. This error does not
    matter, because the spot is wider than δ and determines the profile of the edge.

    The length is the delay of the shutter times the writing speed, such as 5 µs x 40 mm/s = 0.2 µm.
    """
    along_y, along_x = gradient(layout, context.pitch_um)
    return layout - values["along_x_um"] * along_x.abs() - values["along_y_um"] * along_y.abs()


@of_exposure(
    "uneven motion of the printer's scanner along the written lines",
    {"strength": Parameter("1", -0.05, 0.05, 0.005)},
    separating="scan each print at 0 and 90 degrees; scan a calibration grating",
)
def galvo_nonlinearity(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Distort the written lines: M(x + c (r² / 3 - x²) / 2R), where x is measured from the centre of a
    printed field of half width r, and R is half the width of the write field.

    If x is measured from the edge of the write field instead, the full displacement is c x (1 - x / 2R). The
    formula above leaves out the part of this displacement that registration removes.

    A galvo or a stage distorts the write field, by a quadratic function of the position along the line.
    """
    fast = 1 if context.slow_axis == "y" else 0
    half_um = context.whole_shape()[fast] * context.pitch_um / 2
    bulge_um = values["strength"] * half_um**2 / (2 * context.radius_um())
    shift_um = bulge_um * (1 / 3 - context.scan_position()[fast] ** 2)
    shift_y, shift_x = (0.0, shift_um) if fast else (shift_um, 0.0)
    return add_warp(layout, shift_y, shift_x, context.pitch_um)


@of_exposure(
    "resist depleted by the lines written just before",
    {
        "strength": Parameter("1", -0.6, 0.6, 0.05),
        "length_um": Parameter("µm", 0.4, 20.0, 3.0, "shape", tried=(1.0, 3.0, 9.0)),
        "direction": DIRECTION,
    },
    stage="resist",
    separating="print the same layout with the writing order reversed",
)
def write_order_memory(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Let earlier lines deplete the resist: D = max(M - e K_l * M, 0). Here e is the strength of the
    depletion, and the kernel K_l is a one-sided exponential of length l along the slow axis.

    Oxygen and radicals are depleted along the slow writing axis, which is y unless the card says x.
    """
    strength, length, direction = values["strength"], values["length_um"], values["direction"]
    pitch = context.pitch_um

    def transfer_minus_one(fy: Tensor, fx: Tensor) -> Tensor:
        along = fy if context.slow_axis == "y" else fx
        return -strength * trailing_response(direction * along, length, pitch)

    starved = add_filtered(layout, transfer_minus_one, pitch, _TAIL_LENGTHS * float(length.detach()))
    # Where another effect has already made the dose negative, the dose is not reduced further.
    least = layout.clamp(max=0)
    return least + torch.relu(starved - least)


@of_exposure(
    "ripples at the hatching pitch",
    {
        "cosine_um": Parameter("µm", -0.1, 0.1, 0.01),
        "sine_um": Parameter("µm", -0.1, 0.1, 0.01),
        "frequency_per_um": Parameter("1/µm", _SLOWEST_PER_UM, 0.7, 0.3, "shape", tried=_RIPPLES_PER_UM),
    },
    role="nuisance",
    acts_on="height",
    separating="rescan at 25 nm per pixel",
)
def hatch_ripple(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Add ripples that come from the hatching of pitch p: H + 1[M > 0] (a cos 2π f y + b sin 2π f y), where y
    is the position along the slow axis.

    The frequency f is the alias frequency |1/p - 1/dx|, where dx is the pixel size. The ripples have a fixed
    phase in the write field, so they are the same in every print.

    The paper's figure of the noise shows such ripples, for hatching with a pitch of 0.1 µm.
    """
    across_um = context.centred_um()["yx".index(context.slow_axis)]
    phase = 2 * math.pi * values["frequency_per_um"] * across_um
    ripple = values["cosine_um"] * torch.cos(phase) + values["sine_um"] * torch.sin(phase)
    return height + (context.layout_um > 0) * ripple
