"""Noise: what no model of the printer can predict, and whether a stated uncertainty is right."""

from litho_models.noise.analyse import NoiseAnalysis, analyse_noise, analyse_noise_of_files

__all__ = ["NoiseAnalysis", "analyse_noise", "analyse_noise_of_files"]
