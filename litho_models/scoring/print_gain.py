"""Gain and offset of one print against a prediction, measured together, with their covariance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from litho_models.scan_terms import Blocks


class PrintGain(NamedTuple):
    """Measured height = slope · prediction + intercept, µm; standard errors and correlation of the two.

    NaN where they cannot be known: a constant prediction has no slope, a single block no errors.
    """

    slope: float
    intercept_um: float
    slope_error: float
    intercept_error_um: float
    correlation: float


def print_gain(
    height_um: np.ndarray, prediction_um: np.ndarray, used: np.ndarray, *, block_px: int = Blocks().block_px
) -> PrintGain:
    """Least-squares line through the used pixels of a scan.

    Neighbouring pixels share their residual, so the covariance is that of whole blocks (Liang and Zeger
    1986): the sums of residual times regressor over a block are taken as independent from block to
    block, which holds where blocks are wide against the correlation length (7 px on the measured prints).

    Args:
        height_um, prediction_um: (ny, nx), float; ``used``: (ny, nx) bool, one pixel at least.
        block_px: side of a block.
    """
    x, y = (np.asarray(a, np.float64)[used] for a in (prediction_um, height_um))
    middle = x.mean()
    power = float(((x - middle) ** 2).sum())
    if power <= 0:
        nan = float("nan")
        return PrintGain(nan, float(y.mean()), nan, nan, nan)
    # About the mean of the prediction slope and height are estimated independently of each other.
    regressors = np.stack([np.full(x.size, 1 / x.size), (x - middle) / power])
    height, slope = regressors @ y
    residual = y - height - slope * (x - middle)
    rows, columns = np.nonzero(used)
    block = (rows // block_px) * (used.shape[1] // block_px + 1) + columns // block_px
    influence = np.stack([np.bincount(block, weights=own * residual) for own in regressors])
    count = np.unique(block).size
    covariance = influence @ influence.T * (count / (count - 1) if count > 1 else np.nan)
    to_line = np.array([[1.0, -middle], [0.0, 1.0]])
    (intercept_variance, shared), (_, slope_variance) = to_line @ covariance @ to_line.T
    errors = float(np.sqrt(slope_variance)), float(np.sqrt(intercept_variance))
    return PrintGain(
        slope=float(slope),
        intercept_um=float(height - slope * middle),
        slope_error=errors[0],
        intercept_error_um=errors[1],
        correlation=float(shared / (errors[0] * errors[1])) if min(errors) > 0 else float("nan"),
    )
