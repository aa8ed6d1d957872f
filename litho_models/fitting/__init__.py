"""Fit models of the printer to measured scans of prints."""

from litho_models.fitting.config import TrainingConfig
from litho_models.fitting.fit import Fitted, fit, fit_in_cache

__all__ = ["Fitted", "TrainingConfig", "fit", "fit_in_cache"]
