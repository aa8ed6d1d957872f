"""Measurement: what the microscope and its operator do to the height axis."""

from __future__ import annotations

import torch
from torch import Tensor

from litho_models.effects.effect import FieldContext, Parameter, Values, of_microscope
from litho_models.scan_terms.term import CREEP_DECAYS

_STEP = "scan a step standard and a bare substrate before and after the print"


@of_microscope(
    "zero of the single scan",
    {"offset_um": Parameter("µm", -0.5, 0.5, 0.03)},
    source="levelling without a reference surface",
    separating="leave bare substrate in every field",
    per_scan=True,
)
def datum_offset(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H + o: the zero of one scan."""
    return height + values["offset_um"]


@of_microscope(
    "height calibration of the single scan",
    {"gain": Parameter("1", -0.2, 0.2, 0.02)},
    source="calibration of the z-scanner",
    separating=_STEP,
    per_scan=True,
)
def z_gain(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """(1 + g) H: the height calibration of one scan."""
    return (1 + values["gain"]) * height


@of_microscope(
    "tilt and bow of the single scan",
    {
        name: Parameter("µm", -0.5, 0.5, 0.02)
        for name in ("tilt_x_um", "tilt_y_um", "bow_xx_um", "bow_xy_um", "bow_yy_um")
    },
    source="sample tilt, scanner bow, and what polynomial levelling left or took",
    separating=_STEP,
    per_scan=True,
)
def tilt_bow(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H + a x + b y + c x² + d xy + e y², x and y from -1 to 1."""
    y, x = context.scan_position()
    tilt = values["tilt_x_um"] * x + values["tilt_y_um"] * y
    bow = values["bow_xx_um"] * x * x + values["bow_xy_um"] * x * y + values["bow_yy_um"] * y * y
    return height + tilt + bow


@of_microscope(
    "height offset of every scan line",
    {"sd_um": Parameter("µm", 0.0, 0.1, 0.008)},
    source="drift and feedback noise between the lines of a raster scan",
    separating="scan the same field at 0 and 90 degrees",
    per_scan=True,
)
def scan_line_stripes(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H + s_i, s_i ~ N(0, σ²) for each scan line i, drawn from the context's seed."""
    line = context.line()
    generator = torch.Generator().manual_seed(context.seed)
    draws = torch.randn(int(line.max()) + 1, generator=generator).to(height)
    return height + values["sd_um"] * draws[line]


@of_microscope(
    "creep after the scan starts",
    {name: Parameter("µm", -1.0, 1.0, 0.03) for name in CREEP_DECAYS},
    source="exponential creep of the scanner; its slow part lies in the bow",
    separating="scan the same field twice in a row, downwards and upwards",
    per_scan=True,
)
def slow_drift(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H + Σ c exp(-t / τ), t the scan line from 0 (first) to 1 (last): creep after the scan starts."""
    time = context.line().to(height.dtype) / max(context.whole_shape()[0] - 1, 1)
    return height + sum(values[name] * torch.exp(-time / decay) for name, decay in CREEP_DECAYS.items())
