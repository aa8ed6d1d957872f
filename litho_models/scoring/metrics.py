"""Error figures: over the valid pixels of a scan first, then over scans; intervals over scans.

Pixels of one scan are correlated, scans are (nearly) independent: every interval and every test
resamples whole scans.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from litho_data.foundation.errors import InputError
from litho_models.scan_terms.nuisance import BLOCK_PX, BUFFER_PX, Policy, cross_fitted_residual
from litho_models.scoring.print_gain import print_gain

NM_PER_UM = 1000.0
# The step of index from air to the resist, at a red helium-neon line: where its elements are used.
INDEX_STEP, WAVELENGTH_UM = 0.548, 0.6328
BOOTSTRAP_DRAWS = 2000
EXACT_SIGN_FLIP_SCANS = 14
SIGN_FLIP_DRAWS = 9999


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
    *,
    block_px: int = BLOCK_PX,
    buffer_px: int = BUFFER_PX,
    seed: int = 0,
    scan_line: np.ndarray | None = None,
) -> ScanScore:
    """Score one prediction against one scan; arrays (ny, nx) in µm, the rest as in ``cross_fitted_residual``.

    Slope and intercept, the gain and offset of the print, are those of ``print_gain``.

    Raises:
        InputError: what ``cross_fitted_residual`` refuses, or no valid pixel.
    """
    free = cross_fitted_residual(
        height_um,
        prediction_um,
        valid,
        policy,
        block_px=block_px,
        buffer_px=buffer_px,
        seed=seed,
        scan_line=scan_line,
    )
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


def bootstrap_interval(
    values: Sequence[float], *, level: float = 0.95, draws: int = BOOTSTRAP_DRAWS, seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of the mean over scans, resampling whole scans.

    With one scan there is nothing to resample: both ends are NaN.
    """
    sample = np.asarray(values, np.float64)
    if sample.size < 2:
        return float("nan"), float("nan")
    picks = np.random.default_rng(seed).integers(0, sample.size, size=(draws, sample.size))
    means = sample[picks].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


@dataclass(frozen=True)
class PairedDifference:
    """Mean over scans of (first minus second), its bootstrap interval and two-sided sign-flip p."""

    mean: float
    interval: tuple[float, float]
    p: float
    first_better: int
    scans: int


def paired_difference(first: Sequence[float], second: Sequence[float], *, seed: int = 0) -> PairedDifference:
    """Compare two models scan by scan; smaller values are better.

    The null flips the sign of each scan's difference: all combinations up to 14 scans, 9,999 random
    ones beyond (the observed one counted in).

    Raises:
        InputError: lists of different length, or empty.
    """
    if len(first) != len(second) or not first:
        raise InputError(
            "paired scores", got=f"{len(first)} and {len(second)} scans", wanted="the same scans in both"
        )
    difference = np.asarray(first, np.float64) - np.asarray(second, np.float64)
    count = difference.size
    if count <= EXACT_SIGN_FLIP_SCANS:
        signs = 1.0 - 2.0 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
    else:
        drawn = np.random.default_rng(seed).choice([-1.0, 1.0], size=(SIGN_FLIP_DRAWS, count))
        signs = np.vstack([np.ones(count), drawn])
    flipped = np.abs(signs @ difference)
    # The observed sum is one of the flips; rounding must not put it below itself.
    p = float(np.mean(flipped >= abs(difference.sum()) * (1 - 1e-12)))
    return PairedDifference(
        mean=float(difference.mean()),
        interval=bootstrap_interval(difference.tolist(), seed=seed),
        p=p,
        first_better=int((difference < 0).sum()),
        scans=count,
    )
