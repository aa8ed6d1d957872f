"""Check whether a printer still behaves as its frozen model predicts."""

from litho_models.monitoring.check import check
from litho_models.monitoring.prints import Check

__all__ = ["Check", "check"]
