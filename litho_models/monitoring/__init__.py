"""Monitor a printer: test whether new prints still behave as the frozen model of the printer predicts."""

from litho_models.monitoring.check import check
from litho_models.monitoring.prints import Check

__all__ = ["Check", "check"]
