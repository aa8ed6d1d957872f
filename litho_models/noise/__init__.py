"""Estimate the noise of prints, i.e. the part of the error that no model can predict. Also test whether
stated uncertainties are calibrated.
"""

from litho_models.noise.analyse import analyse_noise, analyse_noise_of_files
from litho_models.noise.result import NoiseAnalysis

__all__ = ["NoiseAnalysis", "analyse_noise", "analyse_noise_of_files"]
