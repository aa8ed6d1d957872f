"""Measurement: what the microscope and its operator do to the height axis."""

from __future__ import annotations

import torch
from torch import Tensor

from litho_models.effects.effect import FieldContext, Parameter, Values, of_microscope
from litho_models.scan_terms.term import CREEP_DECAYS


def datum_offset(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H + o: the zero of one scan."""
    return height + values["offset_um"]


def z_gain(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """(1 + g) H: the height calibration of one scan."""
    return (1 + values["gain"]) * height


def tilt_bow(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H + a x + b y + c x² + d xy + e y², x and y from -1 to 1."""
    y, x = context.scan_position()
    return (
        height
        + values["tilt_x_um"] * x
        + values["tilt_y_um"] * y
        + values["bow_xx_um"] * x * x
        + values["bow_xy_um"] * x * y
        + values["bow_yy_um"] * y * y
    )


def scan_line_stripes(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H + s_i, s_i ~ N(0, σ²) for each scan line i, drawn from the context's seed."""
    line = context.line()
    generator = torch.Generator().manual_seed(context.seed)
    draws = torch.randn(int(line.max()) + 1, generator=generator).to(height)
    return height + values["sd_um"] * draws[line]


def slow_drift(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """H + Σ c exp(-t / τ), t the scan line from 0 (first) to 1 (last): creep after the scan starts."""
    time = context.line().to(height.dtype) / max(context.whole_shape()[0] - 1, 1)
    return height + sum(values[name] * torch.exp(-time / decay) for name, decay in CREEP_DECAYS.items())


_STEP = "scan a step standard and a bare substrate before and after the print"

EFFECTS = (
    of_microscope(
        name="datum-offset",
        title="zero of the single scan",
        parameters={"offset_um": Parameter("µm", -0.5, 0.5, 0.03)},
        apply=datum_offset,
        source="levelling without a reference surface",
        separating="leave bare substrate in every field",
        per_scan=True,
    ),
    of_microscope(
        name="z-gain",
        title="height calibration of the single scan",
        parameters={"gain": Parameter("1", -0.2, 0.2, 0.02)},
        apply=z_gain,
        source="calibration of the z-scanner",
        separating=_STEP,
        per_scan=True,
    ),
    of_microscope(
        name="tilt-bow",
        title="tilt and bow of the single scan",
        parameters={
            name: Parameter("µm", -0.5, 0.5, 0.02)
            for name in ("tilt_x_um", "tilt_y_um", "bow_xx_um", "bow_xy_um", "bow_yy_um")
        },
        apply=tilt_bow,
        source="sample tilt, scanner bow, and what polynomial levelling left or took",
        separating=_STEP,
        per_scan=True,
    ),
    of_microscope(
        name="scan-line-stripes",
        title="height offset of every scan line",
        parameters={"sd_um": Parameter("µm", 0.0, 0.1, 0.008)},
        apply=scan_line_stripes,
        source="drift and feedback noise between the lines of a raster scan",
        separating="scan the same field at 0 and 90 degrees",
        per_scan=True,
    ),
    of_microscope(
        name="slow-drift",
        title="creep after the scan starts",
        parameters={name: Parameter("µm", -1.0, 1.0, 0.03) for name in CREEP_DECAYS},
        apply=slow_drift,
        source="exponential creep of the scanner; its slow part lies in the bow",
        separating="scan the same field twice in a row, downwards and upwards",
        per_scan=True,
    ),
)
