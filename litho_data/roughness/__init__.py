"""Measure roughness, noise and step heights of scans, and compute how much of the roughness is removed by
levelling.
"""

from litho_data.roughness.amplitude import (
    AmplitudeParameters,
    amplitude_parameters,
    autocorrelation,
    effective_samples,
    sq_uncertainty_nm,
)
from litho_data.roughness.grating import Scale, Wave, axis_scales, find_wave, line_bow
from litho_data.roughness.levelling_bias import (
    exponential_correlation,
    gaussian_correlation,
    retained_variance,
)
from litho_data.roughness.noise import white_noise
from litho_data.roughness.spectrum import Spectrum, psd_along
from litho_data.roughness.step_height import StepHeight, find_step, groove_depth, stair_steps
from litho_data.roughness.texture import LineDirection, LinePeriod, line_direction, line_period

__all__ = [
    "AmplitudeParameters",
    "LineDirection",
    "LinePeriod",
    "Scale",
    "Spectrum",
    "StepHeight",
    "Wave",
    "amplitude_parameters",
    "autocorrelation",
    "axis_scales",
    "effective_samples",
    "exponential_correlation",
    "find_step",
    "find_wave",
    "gaussian_correlation",
    "groove_depth",
    "line_bow",
    "line_direction",
    "line_period",
    "psd_along",
    "retained_variance",
    "sq_uncertainty_nm",
    "stair_steps",
    "white_noise",
]
