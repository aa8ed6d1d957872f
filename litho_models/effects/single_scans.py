"""What single scans add, each its own: facts alone. Their formulas are their scan terms, which fit them."""

from __future__ import annotations

from functools import partial

from litho_models.effects.effect import Effect, Parameter, of_single_scans
from litho_models.scan_terms.term import CREEP_DECAYS

_of_microscope = partial(
    Effect, stage="measurement", role="measurement", acts_on="height", apply=of_single_scans
)
_STEP = "scan a step standard and a bare substrate before and after the print"

EFFECTS = (
    Effect(
        "line-roughness",
        "height of the single written line",
        stage="exposure",
        role="nuisance",
        acts_on="height",
        parameters={"sd_um": Parameter("µm", 0.0, 0.1, 0.008)},
        apply=of_single_scans,
        source="arXiv:2309.17343, line-like noise along the hatching; random, so no model predicts it",
        separating="scan the same field at 0 and 90 degrees",
    ),
    _of_microscope(
        "registration-residual",
        "shift and distortion left by the registration",
        parameters={
            name: Parameter("µm", -0.5, 0.5, 0.05)
            for name in (
                *("shift_y_um", "y_by_y_um", "y_by_x_um", "shift_x_um", "x_by_y_um", "x_by_x_um"),
                *(f"{axis}_by_{power}_um" for axis in ("y", "x") for power in ("yy", "xy", "xx")),
            )
        },
        source="error of the lateral map from scan to layout, affine and quadratic",
        separating="alignment marks in every field",
    ),
    _of_microscope(
        "z-gain",
        "height calibration of the single scan",
        parameters={"gain": Parameter("1", -0.2, 0.2, 0.02)},
        source="calibration of the z-scanner",
        separating=_STEP,
    ),
    _of_microscope(
        "datum-offset",
        "zero of the single scan",
        parameters={"offset_um": Parameter("µm", -0.5, 0.5, 0.03)},
        source="levelling without a reference surface",
        separating="leave bare substrate in every field",
    ),
    _of_microscope(
        "tilt-bow",
        "tilt and bow of the single scan",
        parameters={
            name: Parameter("µm", -0.5, 0.5, 0.02)
            for name in ("tilt_x_um", "tilt_y_um", "bow_xx_um", "bow_xy_um", "bow_yy_um")
        },
        source="sample tilt, scanner bow, and what polynomial levelling left or took",
        separating=_STEP,
    ),
    _of_microscope(
        "scan-line-stripes",
        "height offset of every scan line",
        parameters={"sd_um": Parameter("µm", 0.0, 0.1, 0.008)},
        source="drift and feedback noise between the lines of a raster scan",
        separating="scan the same field at 0 and 90 degrees",
    ),
    _of_microscope(
        "slow-drift",
        "creep after the scan starts",
        parameters={name: Parameter("µm", -1.0, 1.0, 0.03) for name in CREEP_DECAYS},
        source="exponential creep of the scanner; its slow part lies in the bow",
        separating="scan the same field twice in a row, downwards and upwards",
    ),
)
