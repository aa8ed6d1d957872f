"""The errors of one scan, over its valid pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import NM_PER_UM
from litho_models.scan_terms import Blocks, LineIndex, Policy, cross_fit, policy_terms
from litho_models.scoring.print_gain import print_gain

# The step of index from air to the resist, at a red helium-neon line: where its elements are used.
INDEX_STEP, WAVELENGTH_UM = 0.548, 0.6328


@dataclass(frozen=True)
class ScanScore:
    """Error of one model on one scan, nm over the scored pixels.

    ``*_abs`` and ``bias`` (measured minus predicted) use no fit at test time; ``*_datum_free`` are
    freed of the nuisances of ``policy``, fitted on other pixels, with ``degrees_of_freedom`` terms.
    """

    scan_id: str
    policy: str
    degrees_of_freedom: float
    pixels: int
    mae_abs_nm: float
    rmse_abs_nm: float
    bias_nm: float
    mae_datum_free_nm: float
    rmse_datum_free_nm: float
    median_abs_datum_free_nm: float
    p95_abs_datum_free_nm: float
    slope: float
    slope_error: float
    intercept_nm: float
    intercept_error_nm: float
    slope_intercept_correlation: float


def score_scan(
    scan_id: str,
    height_um: np.ndarray,
    prediction_um: np.ndarray,
    valid: np.ndarray,
    policy: Policy = "offset",
    blocks: Blocks | None = None,
    *,
    scan_line: LineIndex | None = None,
) -> ScanScore:
    """Score one prediction against one scan; arrays (ny, nx) in µm, the rest as in ``cross_fit``.

    Slope and intercept, the gain and offset of the print, are those of ``print_gain``.

    Raises:
        InputError: what ``cross_fit`` refuses, or no valid pixel.
    """
    free = cross_fit(height_um, prediction_um, valid, policy_terms(policy), blocks, scan_line=scan_line)
    scored = np.isfinite(free.residual_um)
    if not scored.any():
        raise InputError(f"scan {scan_id}", got="no valid pixel", wanted="at least one to score")
    height, prediction = (np.asarray(a, np.float64)[scored] for a in (height_um, prediction_um))
    plain = (height - prediction) * NM_PER_UM
    error = np.abs(free.residual_um[scored]) * NM_PER_UM
    line = print_gain(height_um, prediction_um, scored)
    return ScanScore(
        scan_id=scan_id,
        policy=policy,
        degrees_of_freedom=free.degrees_of_freedom,
        pixels=int(scored.sum()),
        mae_abs_nm=float(np.abs(plain).mean()),
        rmse_abs_nm=float(np.sqrt((plain**2).mean())),
        bias_nm=float(plain.mean()),
        mae_datum_free_nm=float(error.mean()),
        rmse_datum_free_nm=float(np.sqrt((error**2).mean())),
        median_abs_datum_free_nm=float(np.median(error)),
        p95_abs_datum_free_nm=float(np.quantile(error, 0.95)),
        slope=line.slope,
        slope_error=line.slope_error,
        intercept_nm=line.intercept_um * NM_PER_UM,
        intercept_error_nm=line.intercept_error_um * NM_PER_UM,
        slope_intercept_correlation=line.correlation,
    )


def phase_waves(height_error_um: float) -> float:
    """Phase error, in waves, of light that passes an element whose height is wrong by so many µm."""
    return height_error_um * INDEX_STEP / WAVELENGTH_UM
