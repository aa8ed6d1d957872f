"""Per-scan nuisances fitted jointly with a model, and the background that all scans have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.scan_terms.background import Background, field_um
from litho_models.scan_terms.nuisance import (
    TERM_COUNT,
    Policy,
    least_squares,
    nuisance_basis,
    row_index,
    shrunk_line_offsets,
)

_GAIN_TERM = 1


def estimate_nuisances(
    scans: Sequence[PrintedScan],
    predictions_um: Sequence[np.ndarray],
    policy: Policy,
    free_gain: bool = False,
) -> list[np.ndarray]:
    """What each scan adds to the model's height, float32 (ny, nx) µm, fitted on all its valid pixels.

    For training only: a reported error takes its nuisances from ``cross_fitted_residual``.
    """
    bases = [training_basis(prediction, policy, free_gain) for prediction in predictions_um]
    fitted = [
        _coefficients(scan, prediction, basis)
        for scan, prediction, basis in zip(scans, predictions_um, bases, strict=True)
    ]
    coefficients = np.array(fitted)
    pinned = pinned_terms(policy, free_gain)
    coefficients[:, :pinned] -= coefficients[:, :pinned].mean(axis=0)
    maps = []
    for scan, prediction, basis, own in zip(scans, predictions_um, bases, coefficients, strict=True):
        smooth = np.tensordot(own, basis, axes=1)
        if policy == "full+rows":
            smooth = smooth + _row_offsets(scan, prediction, smooth)
        maps.append(smooth.astype(np.float32))
    return maps


def learn_background(scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray]) -> Background:
    """The smooth background that the scans have in common beside a fitted model's heights.

    Each scan is fitted with all terms of policy ``full``, offset and gain included, on its valid pixels;
    the mean over the scans of the five smooth terms is kept.

    Args:
        scans: the scans that the model was fitted to, of one size; ``predictions_um``: its heights (ny, nx).
    """
    coefficients = [
        _coefficients(scan, prediction, nuisance_basis(prediction, "full"))
        for scan, prediction in zip(scans, predictions_um, strict=True)
    ]
    x, y, xx, xy, yy = (NM_PER_UM * np.mean(coefficients, axis=0)[2:]).tolist()
    return Background(
        x_nm=x, y_nm=y, xx_nm=xx, xy_nm=xy, yy_nm=yy, field_um=field_um(scans[0]), scans=len(scans)
    )


def training_basis(prediction_um: np.ndarray, policy: Policy, free_gain: bool) -> np.ndarray:
    """The policy's terms (k, ny, nx), without the gain unless it is free.

    A scan's gain is partly what the layout does to the height over long distances; a model whose
    scans may each choose their gain does not learn that.
    """
    basis = nuisance_basis(prediction_um, policy)
    return basis if free_gain else np.delete(basis, np.s_[_GAIN_TERM : _GAIN_TERM + 1], axis=0)


def pinned_terms(policy: Policy, free_gain: bool) -> int:
    """Number of leading terms whose mean over scans is zero: offset and gain of all belong to the process."""
    return min(TERM_COUNT[policy], 2 if free_gain else 1)


def _coefficients(scan: PrintedScan, prediction: np.ndarray, basis: np.ndarray) -> np.ndarray:
    if not len(basis):
        return np.zeros(0)
    usable = scan.valid & np.isfinite(scan.height_um)
    design = basis[:, usable]
    target = (scan.height_um - prediction)[usable].astype(np.float64)
    return least_squares(design, target)


def _row_offsets(scan: PrintedScan, prediction: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    usable = scan.valid & np.isfinite(scan.height_um)
    residual = np.where(usable, scan.height_um - prediction - smooth, 0.0)
    rows = row_index(scan.shape)
    offsets, _, _ = shrunk_line_offsets(residual, usable, rows)
    return offsets[rows]
