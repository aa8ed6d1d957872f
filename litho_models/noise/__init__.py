"""Noise: what no model of the printer can predict, and whether a stated uncertainty is right."""

from litho_models.noise.analyse import analyse_noise, analyse_noise_of_files
from litho_models.noise.result import NoiseAnalysis

__all__ = ["NoiseAnalysis", "analyse_noise", "analyse_noise_of_files"]
