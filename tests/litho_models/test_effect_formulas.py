"""Check effects on a plane, where each formula of the catalogue is simple arithmetic.

The formulas are implemented again here, following the docstrings. On a plane, the slope is known, smoothing
does not change the height, and the heights at displaced positions are known.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from litho_models.effects import FieldContext, get_effect

SHAPE, PITCH_UM, FULL_UM, RADIUS_UM, CENTRE_UM, ORDER = (61, 80), 0.1, 1.2, 30.0, (11.0, -23.0), 0.3
SLOPE_Y, SLOPE_X, MIDDLE_UM = 0.03, -0.05, 0.6
LOCAL_Y, LOCAL_X = np.meshgrid(*((np.arange(n) - (n - 1) / 2) * PITCH_UM for n in SHAPE), indexing="ij")
Y, X = LOCAL_Y + CENTRE_UM[0], LOCAL_X + CENTRE_UM[1]
R2 = X**2 + Y**2
# The position along a scan line, from -1 to 1, and half the length of a line.
U, HALF_X_UM = np.linspace(-1, 1, SHAPE[1]), SHAPE[1] * PITCH_UM / 2
M = MIDDLE_UM + SLOPE_Y * LOCAL_Y + SLOPE_X * LOCAL_X
NEARBY = M / FULL_UM

Field = np.ndarray
FORMULAS: dict[str, tuple[dict[str, float], Callable[..., Field]]] = {
    "vignetting": ({"strength": 0.2}, lambda strength: M * (1 - strength * R2 / RADIUS_UM**2)),
    "laser-drift": ({"drift": 0.2}, lambda drift: M * (1 + drift * ORDER)),
    "field-curvature": (
        {"tilt_x_um": 0.03, "tilt_y_um": 0.05, "curvature_um": 0.07},
        lambda tilt_x_um, tilt_y_um, curvature_um: (
            M + (tilt_x_um * X + tilt_y_um * Y) / RADIUS_UM + curvature_um * R2 / RADIUS_UM**2
        ),
    ),
    "interface-offset": (
        {"depth_um": 0.1, "substrate_um": 0.5, "shrinkage": 0.3, "length_um": 0.3},
        lambda depth_um, substrate_um, shrinkage, length_um: np.where(
            substrate_um < M, np.maximum(M - depth_um * (1 - shrinkage * (1 - NEARBY)), substrate_um), M
        ),
    ),
    "hatch-ripple": (
        {"cosine_um": 0.01, "sine_um": 0.02, "frequency_per_um": 0.3},
        lambda cosine_um, sine_um, frequency_per_um: (
            M
            + cosine_um * np.cos(2 * np.pi * frequency_per_um * Y)
            + sine_um * np.sin(2 * np.pi * frequency_per_um * Y)
        ),
    ),
    "line-shortening": (
        {"along_x_um": 0.1, "along_y_um": 0.3},
        lambda along_x_um, along_y_um: M - along_x_um * abs(SLOPE_X) - along_y_um * abs(SLOPE_Y),
    ),
    "galvo-nonlinearity": (
        {"strength": 2.0},
        lambda strength: M + SLOPE_X * strength * HALF_X_UM**2 / (2 * RADIUS_UM) * (1 / 3 - U**2),
    ),
    "piezo-nonlinearity": (
        {"strength": 1.0},
        lambda strength: M + SLOPE_X * strength * 2 * HALF_X_UM / 4 * (1 / 3 - U**2),
    ),
    "dose-exponent": (
        {"exponent": 1.3},
        lambda exponent: (
            FULL_UM * ((NEARBY + 0.01) ** exponent - 0.01**exponent) / (1.01**exponent - 0.01**exponent)
        ),
    ),
    "height-saturation": ({"rate_per_um": 0.2}, lambda rate_per_um: M / (1 + rate_per_um * M)),
    "vertical-shrinkage": ({"fraction": 0.1}, lambda fraction: (1 - fraction) * M),
    "dose-dependent-shrinkage": (
        {"fraction": 0.2, "length_um": 0.3},
        lambda fraction, length_um: M * (1 - fraction * (1 - NEARBY)),
    ),
    "slope-thinning": (
        {"along_x_um": 0.4, "along_y_um": 0.9, "exponent": 2.0, "turn_deg": 0.0},
        lambda along_x_um, along_y_um, **shape: M - along_x_um * SLOPE_X**2 - along_y_um * SLOPE_Y**2,
    ),
    "tip-dilation": (
        {"radius_um": 0.4, "along": 1.0, "across": 1.0},
        lambda radius_um, **shape: M + radius_um * (SLOPE_X**2 + SLOPE_Y**2) / 2,
    ),
    # A plane is not changed by effects that blur, fill narrow structures, or lag relative to a mean delay.
    "defocus": ({"variance_um2": 0.04}, lambda **values: M),
    "diffusion-blur": ({"variance_um2": 0.04}, lambda **values: M),
    "resampling-blur": ({"variance_um2": 0.04}, lambda **values: M),
    "long-range-proximity": ({"weight": 0.3, "length_um": 0.3}, lambda **values: M),
    "feature-collapse": ({"fraction": 0.3, "width_um": 0.5}, lambda **values: M),
    "trench-residue": ({"fraction": 0.3, "width_um": 0.5}, lambda **values: M),
    # A falling edge lags by l. The mean delay of falling and rising edges is removed.
    "feedback-lag": (
        {"length_um": 0.2, "rising": 0.5, "direction": 1.0},
        lambda length_um, rising, direction: M - SLOPE_X * length_um * (1 - (1 + rising) / 2),
    ),
    "galvo-lag": ({"length_um": 0.1, "direction": 1.0}, lambda **values: M),
}
# PyTorch's cubic interpolation (a = -0.75) is wrong by 0.0482 px on a ramp.
RAMP_OFF_UM = 0.0482 * PITCH_UM * abs(SLOPE_X)
WARPS = {"galvo-nonlinearity", "piezo-nonlinearity", "feedback-lag"}


@pytest.mark.parametrize("name", FORMULAS)
def test_an_effect_on_a_plane_is_what_its_formula_says(name: str) -> None:
    values, formula = FORMULAS[name]
    plane = torch.from_numpy(M)[None, None]
    context = FieldContext(plane, PITCH_UM, FULL_UM, 0.1, CENTRE_UM, RADIUS_UM, "y", ORDER)
    changed = get_effect(name)(plane, values, context)[0, 0].numpy()
    # Compare only pixels more than six kernel lengths from the edge, where the plane ends.
    off = RAMP_OFF_UM if name in WARPS else 1e-7
    inner = np.s_[22:-22, 22:-22]
    np.testing.assert_allclose(changed[inner], formula(**values)[inner], rtol=0, atol=off)
