"""What each measured pixel counts for in a fit. Scores count all pixels alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan
from litho_models.fitting.least_squares import Linearised, Loss, Problem, Room, orthonormal

Weights = Literal["uniform", "sigma"]


def pixel_weights(scan: PrintedScan, weights: Weights) -> np.ndarray:
    """What a residual is multiplied by before the loss, float32 (ny, nx), 0 where nothing is measured.

    ``uniform``: 1. ``sigma``: in proportion to 1 / σ of the height, with mean 1 over the scan, so that scans
    count alike; squares are then weighted by 1 / σ², absolute values by 1 / σ.

    Raises:
        InputError: ``sigma`` for a scan without σ.
    """
    usable = scan.usable
    if weights == "uniform":
        return usable.astype(np.float32)
    sigma_um = scan.height_sigma_um
    known = None if sigma_um is None else usable & (sigma_um > 0)
    if sigma_um is None or known is None or not known.any():
        raise InputError(
            f"weights of scan {scan.id}",
            got="no height_sigma_um in the store",
            wanted="a store that has it",
            hint="build the store again from its card, or use uniform weights",
        )
    inverse = np.divide(1.0, sigma_um, out=np.zeros(scan.shape), where=known)
    return (inverse / inverse[known].mean()).astype(np.float32)


def grid_pixels(scan: PrintedScan, count: int) -> np.ndarray:
    """Flat indices of the measured pixels on a square grid of about ``count`` pixels."""
    step = max(1, round((scan.usable.size / count) ** 0.5))
    grid = np.zeros_like(scan.usable)
    grid[::step, ::step] = True
    return np.flatnonzero(scan.usable & grid)


class Weighted:
    """A least-squares problem whose residuals are multiplied by weights.

    Args:
        problem: the problem; ``weights``: of its scans, (n,) each.
        loss: with ``squares`` what a scan may add is made orthonormal again, as ``eliminated`` wants it.
    """

    def __init__(self, problem: Problem, weights: Sequence[np.ndarray], loss: Loss):
        self._problem, self._weights, self._loss = problem, weights, loss

    def linearise(self, vector: np.ndarray) -> list[Linearised]:
        """All scans at these parameters."""
        found = zip(self._problem.linearise(vector), self._weights, strict=True)
        return [
            Linearised(weight * one.residual, weight * one.jacobian, self._basis(weight * one.basis))
            for one, weight in found
        ]

    def residuals(self, vector: np.ndarray) -> list[np.ndarray]:
        """Measured minus predicted of all scans, weighted, µm."""
        found = self._problem.residuals(vector)
        return [weight * one for one, weight in zip(found, self._weights, strict=True)]

    def room(self, vector: np.ndarray) -> Room | None:
        """That of the problem."""
        return self._problem.room(vector)

    def _basis(self, basis: np.ndarray) -> np.ndarray:
        return orthonormal(basis.T).T if self._loss == "squares" else basis
