"""Fitting models to printed scans."""

from litho_models.fitting.config import TrainingConfig
from litho_models.fitting.fit import Fitted, fit, fit_in_cache

__all__ = ["Fitted", "TrainingConfig", "fit", "fit_in_cache"]
