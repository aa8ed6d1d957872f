"""Resist: how dose becomes height before development."""

from __future__ import annotations

import torch
from torch import Tensor

from litho_models.effects.effect import FieldContext, Parameter, Values, of_resist
from litho_models.effects.filters import add_blur

_BLUR_REACH_UM = 4.0


@of_resist(
    "reactants diffusing sideways",
    {"variance_um2": Parameter("µm²", 0.0, 1.0, 0.01, tried=(0.01, 0.09))},
    source="Lang 2022, arXiv:2205.14891; the paper's diffusion kernel",
    separating="step edges of two heights, scanned with two pixel sizes and a new tip",
)
def diffusion_blur(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H blurred by an isotropic Gaussian of variance s²: reactants diffuse after the exposure."""
    return add_blur(height, values["variance_um2"], context.pitch_um, _BLUR_REACH_UM)


@of_resist(
    "exposure threshold of the resist",
    {
        "steepness_squared": Parameter("1", 0.0, 60.0, 2.0),
        "centre": Parameter("1", 0.05, 0.95, 0.5, "shape", tried=(0.2, 0.5, 0.8)),
    },
    source="Zhou 2014, the normalised projection used in the paper's Physics model",
    separating="a wide staircase of all levels",
)
def threshold_softness(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Normalised tanh projection about η, identity for α² -> 0 and a step for α² -> inf.

    With x = H / full height: sinh(αx) / sinh(α) · cosh(α(1 - η)) / cosh(α(x - η)), which is the
    quotient of sums of tanh usually printed, and is even and analytic in α.
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
    source="first-order saturation of the printed height",
    separating="a wide staircase of all levels",
)
def height_saturation(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H / (1 + q |H|): tall structures grow less than the dose says."""
    return height / (1 + values["rate_per_um"] * torch.abs(height))
