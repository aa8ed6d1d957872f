"""Effects of the resist: conversion of dose to height, shrinkage, and height gained or lost in
development.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from litho_models.effects.effect import ALONG_AXES, FieldContext, Parameter, Values, of_development, of_resist
from litho_models.effects.filters import add_blur, add_warp, gradient, rounded_power

_BLUR_REACH_UM = 4.0
_OF_NARROW = {
    "fraction": Parameter("1", 0.0, 0.9, 0.1),
    "width_um": Parameter("µm", 0.2, 3.0, 0.5, "shape", tried=(0.4, 0.8, 1.4)),
}


@of_resist(
    "reactants diffusing sideways",
    {"variance_um2": Parameter("µm²", 0.0, 1.0, 0.01, tried=(0.01, 0.09))},
    separating="step edges of two heights, scanned with two pixel sizes and a new tip",
)
def diffusion_blur(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Blur H by an isotropic Gaussian of variance s², which describes reactants that diffuse after the
    exposure.

    Source: Lang 2022, arXiv:2205.14891; the paper's diffusion kernel.
    """
    return add_blur(height, values["variance_um2"], context.pitch_um, _BLUR_REACH_UM)


@of_resist(
    "exposure threshold of the resist",
    {
        "steepness_squared": Parameter("1", 0.0, 60.0, 2.0),
        "centre": Parameter("1", 0.05, 0.95, 0.5, "shape", tried=(0.2, 0.5, 0.8)),
    },
    separating="a wide staircase of all levels",
)
def threshold_softness(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Apply the normalised tanh projection with threshold η and steepness α. The projection changes nothing
    for α² -> 0 and becomes a step for α² -> inf.

    With x = H / full height, the projection is sinh(αx) / sinh(α) · cosh(α(1 - η)) / cosh(α(x - η)). This
    expression equals the usual quotient of sums of tanh, and it is even and analytic in α.

    Source: Zhou 2014, the normalised projection used in the paper's Physics model.
    """
    full, centre = context.full_height_um, values["centre"]
    relative = height / full

    def project(steepness_squared: Tensor) -> Tensor:
        alpha = torch.sqrt(steepness_squared + 1e-6)
        ratio = torch.sinh(alpha * relative) / torch.sinh(alpha)
        return ratio * torch.cosh(alpha * (1 - centre)) / torch.cosh(alpha * (relative - centre))

    squared = values["steepness_squared"]
    return height + full * (project(squared) - project(0 * squared))


@of_resist(
    "tall structures growing less than nominal",
    {"rate_per_um": Parameter("1/µm", 0.0, 1.0, 0.1)},
    separating="a wide staircase of all levels",
)
def height_saturation(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Reduce the height of tall structures, whose height is less than proportional to the dose: H / (1 + q
    |H|).

    The printed height saturates to first order.
    """
    return height / (1 + values["rate_per_um"] * torch.abs(height))


@of_development(
    "the whole print losing height in development",
    {"fraction": Parameter("1", 0.0, 0.7, 0.05)},
    separating="a step standard for the microscope, then a printed staircase",
)
def vertical_shrinkage(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Reduce the height of the whole print by a fraction k: (1 - k) H.

    Source: Meisel 2006, cited in the paper.
    """
    return (1 - values["fraction"]) * height


@of_development(
    "print shrinking more where its surroundings are thin",
    {
        "fraction": Parameter("1", 0.0, 0.5, 0.1),
        "length_um": Parameter("µm", 0.3, 6.0, 1.0, "shape", tried=(0.5, 1.5, 4.0)),
    },
    separating="print the same height inside low and high surroundings; a power sweep",
)
def dose_dependent_shrinkage(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Shrink the print more where its surroundings are thin: H (1 - k (1 - u)), where u is the mean nominal
    height nearby as a fraction of the full height.

    Source: Lang 2022, arXiv:2205.14891, where shrinkage falls with dose.
    """
    return height * context.left_by_shrinkage(values["fraction"], values["length_um"])


@of_development(
    "tops shrinking towards the centre of the field",
    {"fraction": Parameter("1", 0.0, 0.1, 0.005)},
    separating="print the layout in fields of two sizes",
)
def lateral_shrinkage(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Shrink the print inwards, at its tops more than at its bases: H(r (1 + s H(r) / H_full)). Here r is the
    position measured from the centre of the field, s is the shrinkage at the full height, and H_full is the
    full height.

    The shrinkage at the mean height is a change of magnification, which registration removes. In a scan, the
    point r = x / (1 + s H_mean / H_full) of the print therefore appears at position x, where H_mean is the
    mean height.

    The print is bound to the substrate at its base, but its top is free.
    """
    places = context.centred_um()
    share = values["fraction"] / context.full_height_um
    raw = 1 / (1 + share * height.mean())

    def looked_up(scale: Tensor) -> Tensor:
        shift_y, shift_x = ((scale - 1) * place for place in places)
        return add_warp(height, shift_y, shift_x, context.pitch_um)

    return looked_up(raw * (1 + share * looked_up(raw)[0, 0]))


@of_development(
    "narrow tall features losing height",
    _OF_NARROW,
    separating="pillars of one height and five widths, dried in air and supercritically",
)
def feature_collapse(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Lower features narrower than w by a fraction φ of their height above the surroundings:
    H - φ (H - open_w(H)), where open_w is the morphological opening by a square of side w.

    Capillary forces bend such features while the print dries.
    """
    return height - values["fraction"] * (height + _closing(-height, values["width_um"], context))


@of_development(
    "resist left in narrow trenches",
    _OF_NARROW,
    separating="trenches of five widths, at two development times",
)
def trench_residue(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Fill pits narrower than w partly with resist: H + ρ (close_w(H) - H), where close_w is the
    morphological closing by a square of side w. The tops are unchanged.
    """
    return height + values["fraction"] * (_closing(height, values["width_um"], context) - height)


def _closing(height: Tensor, width_um: Tensor, context: FieldContext) -> Tensor:
    """Apply a morphological closing by a square to the height, which fills pits narrower than the square.

    A closing can be computed only for squares that are an odd number of pixels wide. For other widths, the
    result is interpolated between the closings by the next smaller and the next larger of these squares.
    """
    half_px = (width_um / context.pitch_um / 2).clamp(min=1)
    below = math.floor(float(half_px.detach()))
    return torch.lerp(_closed_by(height, below), _closed_by(height, below + 1), half_px - below)


def _closed_by(height: Tensor, half_px: int) -> Tensor:
    """Close the height by a square with a side of 2 half_px + 1 pixels. The field is padded with its edge
    values.
    """
    padded = functional.pad(height, (2 * half_px,) * 4, mode="replicate")
    return -_largest(-_largest(padded, half_px), half_px)


def _largest(field: Tensor, half_px: int) -> Tensor:
    """Return the largest value in the square around each pixel, computed along one axis after the other. Each
    step of the computation doubles the number of pixels that are included. The result leaves out the pixels
    whose square extends beyond the field.
    """
    size = 2 * half_px + 1
    for axis in (-2, -1):
        width = 1
        while width < size:
            shift = min(width, size - width)
            left = field.shape[axis] - shift
            field = torch.maximum(field.narrow(axis, 0, left), field.narrow(axis, shift, left))
            width += shift
    return field


@of_development(
    "height lost on slopes",
    {
        "along_x_um": Parameter("µm", 0.0, 2.0, 0.1),
        "along_y_um": Parameter("µm", 0.0, 2.0, 0.1),
        "exponent": Parameter("1", 0.7, 4.0, 2.0, "shape"),
        "turn_deg": Parameter("deg", -90.0, 90.0, 0.0, "shape"),
    },
    role="undetermined",
    trials=tuple(
        {**axes, "exponent": power, "turn_deg": turn}
        for power in (1.0, 2.0)
        for turn in (0.0, 45.0)
        for axes in ALONG_AXES
    ),
    separating="print the same layout at 0 and 90 degrees, scan both at 0 and 90 degrees, with two tips",
)
def slope_thinning(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Remove height on slopes: H - (cx^(2/p) (dH/dx')^2 + cy^(2/p) (dH/dy')^2)^(p/2), where x' and y' are
    rotated axes.

    If cx = cy = c, the loss is c |grad H|^p, regardless of the direction of the slope. If in addition p = 1,
    each edge moves inwards by about c.

    The formula is empirical: the coefficients form an ellipse in rotated axes.
    """
    power, turn = values["exponent"], torch.deg2rad(values["turn_deg"])
    y, x = gradient(height, context.pitch_um)
    along_x, along_y = turn.cos() * x + turn.sin() * y, turn.cos() * y - turn.sin() * x
    # Rounding can make a fitted value slightly negative, and a power of a negative number is not defined.
    loss_x, loss_y = values["along_x_um"].clamp(min=0), values["along_y_um"].clamp(min=0)
    whole = loss_x + loss_y
    share_x, share_y = ((one / whole.clamp(min=1e-12)) ** (2 / power) for one in (loss_x, loss_y))
    return height - whole * rounded_power(share_x * along_x**2 + share_y * along_y**2, power)
