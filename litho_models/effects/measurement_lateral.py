"""Measurement: feedback and lateral scanner; and the registration."""

from __future__ import annotations

import torch
from torch import Tensor

from litho_models.effects.effect import FieldContext, Parameter, Values, of_microscope
from litho_models.effects.filters import add_blur, add_warp

_BLUR_REACH_UM = 4.0


@of_microscope(
    "probe lagging behind the surface along the fast axis",
    {
        "length_um": Parameter("µm", 0.0, 1.5, 0.2, tried=(0.15, 0.4)),
        "rising": Parameter("1", 0.0, 1.0, 0.5, "shape", tried=(1.0, 0.4)),
        "direction": Parameter("1", -1.0, 1.0, 1.0, "choice", tried=(1.0, -1.0)),
    },
    source="first-order feedback loop; a probe that parachutes loses the surface on the way down",
    separating="compare trace and retrace; scan at 0 and 90 degrees",
    reverses=("direction",),
)
def feedback_lag(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """The probe follows late along the fast axis, mean delay taken out: z += (H - z) / (1 + l / dx).

    The length l holds on the way down. On the way up, where the surface pushes, it is a part of it:
    with 1 the probe is a linear filter, below 1 it parachutes off falling edges. The delay is one of time:
    with smaller pixels it is shorter.
    """
    length, pitch = values["length_um"] * context.pixel_size, context.pitch_um
    rising = length * values["rising"]
    forward = 1 if values["direction"] > 0 else -1
    up, down = 1 / (1 + rising / pitch), 1 / (1 + length / pitch)
    first, *columns = height.unbind(-1)[::forward]
    followed = [first]
    for column in columns:
        error = column - followed[-1]
        followed.append(followed[-1] + torch.where(error > 0, up, down) * error)
    late = torch.stack(followed[::forward], dim=-1)
    delay = forward * (length + rising) / 2
    return add_warp(late, 0 * delay, delay, pitch)


@of_microscope(
    "scanner running unevenly along a line",
    {"strength": Parameter("1", -0.05, 0.05, 0.005)},
    source="hysteresis of a piezo scanner, quadratic along the line",
    separating="scan a calibration grating; scan at 0 and 180 degrees",
    reverses=("strength",),
)
def piezo_nonlinearity(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H(x + c L / 4 (1/3 - u²)), u from -1 to 1 over the scan: its x axis runs fast in the middle of a line.

    That is c x (1 - x / L) without its mean, which registration has taken out of a scan.
    """
    y, x = context.scan_position()
    length_um = context.whole_shape()[1] * context.pitch_um
    return add_warp(height, 0 * y, values["strength"] * length_um / 4 * (1 / 3 - x**2), context.pitch_um)


@of_microscope(
    "blur of the finished scan",
    {"variance_um2": Parameter("µm²", 0.0, 1.0, 0.0025, tried=(0.0025, 0.04))},
    source="kernels are 0.03 to 0.06 µm wide at 0.1 µm per pixel; some microscopes are slower",
    separating="register with two interpolation kernels; scan with half the pixel size",
)
def resampling_blur(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """The finished scan blurred by a Gaussian: by interpolation, or by the microscope's own low pass.

    Either is one of pixels: smaller ones blur less.
    """
    variance_um2 = values["variance_um2"] * context.pixel_size**2
    return add_blur(height, variance_um2, context.pitch_um, _BLUR_REACH_UM)
