"""Effects of the exposure: the shape and background of the writing spot, the response of the resist to the
dose, and slices that cure separately.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from litho_models.effects.effect import FieldContext, Parameter, Values, of_exposure
from litho_models.effects.filters import add_blur, add_filtered, add_scattered
from litho_models.models.parts import project

# If the variances of the spot along its two axes differ by less than about this value, the spot is narrowed
# along one axis by as much as it is widened along the other. If the variances differ by more, the excess only
# widens the spot along one axis, so that high frequencies are not amplified further.
_SHARPENING_UM2 = 0.02
_SPOT_REACH_UM = 2.0


@of_exposure(
    "writing spot wider along one direction",
    {
        name: Parameter("µm²", -0.4, 0.4, 0.02, tried=(0.02, 0.1, -0.1))
        for name in ("stretch_um2", "shear_um2")
    },
    separating="print the same layout at 0 and 90 degrees, scan both at 0 and 90 degrees",
)
def elliptical_psf(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Make the spot elliptical: multiply the spectrum of the layout by T = exp(-2 π² fᵀ C f). This adds the
    matrix C to the matrix of second moments of the spot. The parameters of the effect are Cxx - Cyy and
    2 Cxy.

    The spot of the paper is a round Gaussian; here, it has a full second-moment matrix.
    """
    stretch, shear = values["stretch_um2"], values["shear_um2"]
    isotropic = torch.sqrt(stretch**2 + shear**2 + _SHARPENING_UM2**2) - _SHARPENING_UM2

    def transfer_minus_one(fy: Tensor, fx: Tensor) -> Tensor:
        moment = (isotropic + stretch) * fx * fx + (isotropic - stretch) * fy * fy + 2 * shear * fx * fy
        # The base blurs the sharpened frequencies again, but not beside the edges of the field, where it
        # continues the layout. The sharpening is therefore limited to a factor of e.
        return torch.expm1((-(math.pi**2) * moment).clamp(max=1))

    return add_filtered(layout, transfer_minus_one, context.pitch_um, _SPOT_REACH_UM)


@of_exposure(
    "writing spot wider",
    {"variance_um2": Parameter("µm²", 0.0, 1.0, 0.01, tried=(0.01, 0.09))},
    separating="print step edges of two heights through focus",
)
def defocus(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Blur the layout by an isotropic Gaussian of variance s², as a spot out of focus does."""
    return add_blur(layout, values["variance_um2"], context.pitch_um, _SPOT_REACH_UM)


@of_exposure(
    "dose leaking in from the neighbourhood",
    {
        "weight": Parameter("1", -0.3, 1.5, 0.1),
        "length_um": Parameter("µm", 0.6, 10.0, 2.0, "shape", tried=(1.0, 2.0, 4.0, 8.0)),
    },
    separating="print one feature alone and inside dense surroundings of three sizes",
)
def long_range_proximity(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Add the dose that leaks in from the neighbourhood of each pixel; see ``add_scattered``.

    In electron-beam writing, the proximity function is a sum of two Gaussians. Here, weights may be negative.
    """
    return add_scattered(layout, values["weight"], values["length_um"], context.pitch_um)


@of_exposure(
    "height not proportional to dose",
    {"exponent": Parameter("1", 0.4, 2.0, 1.15, null=1.0)},
    separating="a wide staircase of all levels and a power sweep",
)
def dose_exponent(layout: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Raise the dose to a power: D = M_ref (M / M_ref)^p, where M_ref is the full height. Before the power is
    taken, 1 % of M_ref is added to M, so that the slope at M = 0 stays finite.

    The exponent is that of Schwarzschild's law.
    """
    foot = 0.01
    exponent, full = values["exponent"], context.full_height_um
    relative = torch.clamp(layout / full, min=0) + foot
    top, bottom = (1 + foot) ** exponent, foot**exponent
    return layout + full * ((relative**exponent - bottom) / (top - bottom) - (relative - foot))


@of_exposure(
    "slices curing separately",
    {
        "share": Parameter("1", 0.0, 1.0, 0.3),
        "threshold": Parameter("1", 0.2, 0.8, 0.5, "shape", tried=(0.35, 0.5, 0.65)),
        "steepness": Parameter("1", 4.0, 40.0, 12.0, "shape"),
    },
    acts_on="height",
    separating="pillars and pits of one width and several heights, from one slice to many",
)
def layer_stacking(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Cure slices of height t separately: the blurred layout G*M becomes
    (1 - w) G*M + w Σ t·step(G * 1[M >= k t]).

    The effect adds the second expression minus the first to the height. The function ``step`` is a logistic
    function about the threshold, scaled so that it maps 0 to 0 and 1 to 1. A slice that is narrower than the
    spot is lost, and a gap that is narrower than the spot is filled.

    The slices of the paper are 0.1 µm high. A threshold is applied to each slice.
    """
    # ``project`` uses a hyperbolic tangent. With half the steepness, it has the shape of a logistic function.
    exposed = context.exposed_slices
    gained = project(exposed, values["steepness"] / 2, values["threshold"]) - exposed
    return height + values["share"] * context.slice_um * gained.sum(dim=0, keepdim=True)
