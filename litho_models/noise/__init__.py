"""Noise: what no model of the printer can predict, and whether a stated uncertainty is right."""

from litho_models.noise.analyse import noise, noise_of_files
from litho_models.noise.result import NoiseAnalysis

__all__ = ["NoiseAnalysis", "noise", "noise_of_files"]
