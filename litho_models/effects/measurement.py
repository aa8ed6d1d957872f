"""Effects of the measurement, caused by the tip, the feedback loop and the lateral scanner of the
microscope.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from litho_models.effects.effect import DIRECTION, FieldContext, Parameter, Values, of_microscope
from litho_models.effects.filters import add_blur, add_warp

_SHARPEST_UM = 1e-3
# Radius of an asymmetric tip along its sharper axis, relative to the radius along the other axis.
_SHARPER = 0.25
_BLUR_REACH_UM = 4.0


@of_microscope(
    "probe lagging behind the surface along the fast axis",
    {
        "length_um": Parameter("µm", 0.0, 1.5, 0.2, tried=(0.15, 0.4)),
        "rising": Parameter("1", 0.0, 1.0, 0.5, "shape", tried=(1.0, 0.4)),
        "direction": DIRECTION,
    },
    separating="compare trace and retrace; scan at 0 and 90 degrees",
    reverses=("direction",),
    needs=("probe",),
)
def feedback_lag(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Let the probe lag along the fast axis: from pixel to pixel, the measured height z follows the surface H
    by z += (H - z) / (1 + l / dx). The mean delay is removed.

    The length of the lag is l on falling edges, and ``rising`` × l on rising edges, where the surface pushes
    the probe. If ``rising`` is 1, the probe acts as a linear filter. If ``rising`` is below 1, the probe
    follows falling edges more slowly than rising edges, because it loses contact there (parachuting). The
    time constant of the lag is fixed, so l is shorter if the pixels are smaller.

    The feedback loop is of first order. On falling slopes, the probe may lose the surface (parachuting).
    """
    length, pitch = values["length_um"] * context.pixel_size, context.pitch_um
    rising = length * values["rising"]
    forward = 1 if values["direction"] > 0 else -1
    up, down = 1 / (1 + rising / pitch), 1 / (1 + length / pitch)
    first, *columns = height.unbind(-1)[::forward]
    followed = [first]
    for column in columns:
        last = followed[-1]
        followed.append(torch.lerp(last, column, torch.where(column > last, up, down)))
    late = torch.stack(followed[::forward], dim=-1)
    delay = forward * (length + rising) / 2
    return add_warp(late, 0.0, delay, pitch)


@of_microscope(
    "uneven motion of the microscope's scanner along a line",
    {"strength": Parameter("1", -0.05, 0.05, 0.005)},
    separating="scan a calibration grating; scan at 0 and 180 degrees",
    reverses=("strength",),
)
def piezo_nonlinearity(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Let the scanner move unevenly along a line: H(x + c L / 4 (1/3 - u²)), where L is the length of a line
    and u runs from -1 to 1 along it.

    The full displacement is c x (1 - x / L), where x is measured from the start of the line. The formula
    leaves out the part of this displacement that registration removes.

    The hysteresis of a piezo scanner is quadratic along the line.
    """
    _, x = context.scan_position()
    length_um = context.whole_shape()[1] * context.pitch_um
    return add_warp(height, 0.0, values["strength"] * length_um / 4 * (1 / 3 - x**2), context.pitch_um)


@of_microscope(
    "blur of the finished scan",
    {"variance_um2": Parameter("µm²", 0.0, 1.0, 0.0025, tried=(0.0025, 0.04))},
    separating="register with two interpolation kernels; scan with half the pixel size",
)
def resampling_blur(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Blur the finished scan with a Gaussian, as interpolation or the microscope's low-pass filter does.

    The width of the blur is a fixed number of pixels, so smaller pixels give less blur.

    At 0.1 µm per pixel, interpolation kernels are 0.03 to 0.06 µm wide. Some microscopes filter more.
    """
    variance_um2 = values["variance_um2"] * context.pixel_size**2
    return add_blur(height, variance_um2, context.pitch_um, _BLUR_REACH_UM)


@of_microscope(
    "tops widened by a tip of finite radius",
    {
        "radius_um": Parameter("µm", 0.0, 2.0, 0.04),
        "along": Parameter("1", _SHARPER, 1.0, 1.0, "choice"),
        "across": Parameter("1", _SHARPER, 1.0, 1.0, "choice"),
    },
    trials=(
        {"radius_um": 0.04},
        {"radius_um": 0.4},
        {"radius_um": 0.4, "across": _SHARPER},
        {"radius_um": 0.4, "along": _SHARPER},
    ),
    separating="scan again with a new tip, or with the print rotated if the tip is asymmetric; "
    "scan a tip characteriser",
    of_tip=True,
    needs=("probe",),
)
def tip_dilation(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Dilate the surface by a paraboloid tip of radius R: max over u of H(x - u) - u² / 2R. To first order in
    R, the dilated surface is H + R |grad H|² / 2.

    A tip may be sharper along or across the scan lines. Its radii in these directions are ``along`` × R and
    ``across`` × R.

    A worn tip is far blunter than a new one, often along one axis.
    """
    radius = values["radius_um"]
    # The formula divides by the radius. For tips sharper than ``_SHARPEST_UM``, the formula is therefore
    # evaluated at the radius ``_SHARPEST_UM``, and the change of the height is scaled in proportion to the
    # true radius.
    blunt = radius.clamp(min=_SHARPEST_UM)
    # A paraboloid is the sum of two parabolas, so the maximum is taken along one axis after the other.
    across, along = blunt * values["across"], blunt * values["along"]
    columns_done = _dilate_rows(height.transpose(-1, -2), across, context.pitch_um).transpose(-1, -2)
    dilated = _dilate_rows(columns_done, along, context.pitch_um)
    return height + radius / blunt * (dilated - height)


def _dilate_rows(height: Tensor, radius_um: Tensor, pitch_um: float) -> Tensor:
    """Dilate rows by a parabola. The surface is approximated by linear pieces that are half a pixel long.
    ``height`` and the result have shape (..., nx).

    The tip touches an end or the inside of a piece. It can touch the inside of a piece of slope s only at the
    distance R s from the axis of the tip, so at most one pixel has its axis there.
    """
    half_um, size = pitch_um / 2, height.shape[-1]
    pixel = torch.arange(size, device=height.device, dtype=height.dtype)
    # Cubic polynomials through four neighbours give the heights half-way between pixels. Beyond its last
    # pixel, a row is level.
    before, here, after, beyond = (
        functional.pad(height, (1, 2, 0, 0), mode="replicate").unfold(-1, size, 1).unbind(-2)
    )
    middles = torch.where(pixel < size - 1, (9 * (here + after) - before - beyond) / 16, height)
    slopes = (middles - height) / half_um, (after - middles) / half_um
    # The tip cannot touch a point that is farther from its axis than R s, where s is the steepest slope. Nor
    # can it touch a point that is so far away that the parabola has risen there by more than the whole height
    # range. A cubic polynomial overshoots this range by at most an eighth at each end.
    steepest, radius = max(float(one.detach().abs().max()) for one in slopes), float(radius_um.detach())
    range_um = 1.25 * float((height.max() - height.min()).detach())
    reach = min(math.ceil(min(radius * steepest, math.sqrt(2 * radius * range_um)) / pitch_um), size)
    highest = height
    for begins, slope, offset_um in zip((height, middles), slopes, (0.0, half_um), strict=True):
        padded = functional.pad(begins, (reach, reach, 0, 0), mode="replicate")
        for number in range(2 * reach + 1):
            distance_um = (number - reach) * pitch_um + offset_um
            parabola_um = distance_um**2 / (2 * radius_um)
            highest = torch.maximum(highest, padded[..., number : number + size] - parabola_um)
        touch_um = radius_um * slope
        axis = (pixel - (touch_um.detach() / pitch_um).floor()).clamp(0, size - 1)
        away_um = (pixel - axis) * pitch_um + offset_um
        inside = (away_um <= touch_um) & (touch_um < away_um + half_um)
        touched = torch.where(inside, begins + slope * (touch_um / 2 - away_um), -math.inf)
        highest = highest.scatter_reduce(-1, axis.long(), touched, "amax")
    return highest
