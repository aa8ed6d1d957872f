"""σ(x): how the spread of a residual depends on the layout and the place, as a log-linear variance.

The mean comes first and stays as it is; then ln σ² = X β is fitted to its out-of-fold residuals by
maximum likelihood. In two stages the variance cannot flatter the mean, and with some tens of scans
a few covariates are all that can be known (compare Seitzer et al. 2022, arXiv:2203.09168).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan

COVARIATES = ("constant", "level", "level²", "slope", "slope²", "edge distance", "radius²", "radius⁴")
# The optical spot: what the printer makes of an edge of the layout.
_SLOPE_BLUR_UM = 0.2
_FAR_FROM_EDGE_UM = 2.0
# Twice the largest covariate effect seen on noise of 1 to 100 nm: keeps exp() finite on the way.
_LARGEST_STEP = 2.0
_STEPS = 60


class VarianceModel(Record):
    """ln σ² = Σ β_j φ_j, σ in nm; ``coefficients`` in the order of ``covariates``.

    Level on 0 ... 1 of the range; slope of the blurred layout (height over length); distance to the
    next change of level, at most 2 µm, in units of that; radius from the field's centre in units of half
    its diagonal.
    """

    covariates: list[str]
    coefficients: list[float]


class SigmaBin(Record):
    """Pixels within one range of one covariate: the measured and the predicted spread."""

    covariate: str
    low: float
    high: float
    pixels: int
    rms_nm: float
    predicted_nm: float


def covariate_maps(scan: PrintedScan) -> np.ndarray:
    """φ of each pixel of a scan, (covariates, ny, nx)."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter, maximum_filter, minimum_filter

    level = scan.mask_level / (scan.levels - 1)
    blurred = gaussian_filter(
        scan.layout_um.astype(np.float64), _SLOPE_BLUR_UM / scan.pitch_um, mode="nearest"
    )
    slope = np.hypot(*np.gradient(blurred, scan.pitch_um))
    changes = maximum_filter(scan.mask_level, 3) != minimum_filter(scan.mask_level, 3)
    edge_um = np.full(scan.shape, _FAR_FROM_EDGE_UM)
    if changes.any():
        edge_um = np.minimum(distance_transform_edt(~changes) * scan.pitch_um, _FAR_FROM_EDGE_UM)
    y, x = np.meshgrid(*(np.linspace(-1, 1, size) for size in scan.shape), indexing="ij")
    edge = edge_um / _FAR_FROM_EDGE_UM
    radius2 = (y**2 + x**2) / 2
    maps = [np.ones(scan.shape), level, level**2, slope, slope**2, edge, radius2, radius2**2]
    return np.stack(maps)


def fit_log_variance(covariates: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """β of ln σ² = X β by maximum likelihood, Fisher scoring: β += (XᵀX)⁻¹ Xᵀ (r²/σ² − 1).

    The information of a Gaussian about ln σ² is ½ for every pixel, whatever σ is; so one matrix
    serves all steps.

    Args:
        covariates: X, (pixels, k), the first column constant.
        residual: r, (pixels,).

    Raises:
        InputError: no pixels, or residuals that are all zero.
    """
    square = np.asarray(residual, np.float64) ** 2
    if square.size <= covariates.shape[1] or not square.any():
        raise InputError(
            "residuals for a variance",
            got=f"{square.size} pixels, {np.count_nonzero(square)} not zero",
            wanted="more than covariates, and not all zero",
        )
    normal = covariates.T @ covariates
    beta = np.zeros(covariates.shape[1])
    beta[0] = np.log(square.mean())
    for _ in range(_STEPS):
        score = covariates.T @ (square * np.exp(-covariates @ beta) - 1)
        step = np.linalg.lstsq(normal, score, rcond=1e-10)[0]
        largest = np.abs(covariates @ step).max()
        step *= min(1.0, _LARGEST_STEP / largest) if largest > 0 else 1.0
        beta = beta + step
        if largest < 1e-8:
            break
    return beta


def sigma_nm(beta: np.ndarray, covariates: np.ndarray) -> np.ndarray:
    """σ of each pixel, nm; ``covariates`` (..., k)."""
    return np.exp(0.5 * covariates @ beta)


def variance_model(beta: np.ndarray) -> VarianceModel:
    """The fitted coefficients as a record."""
    return VarianceModel(covariates=list(COVARIATES), coefficients=beta.tolist())


def sigma_bins(
    scans: Sequence[PrintedScan],
    residuals_nm: Sequence[np.ndarray],
    sigmas_nm: Sequence[np.ndarray],
    bins: int = 8,
) -> list[SigmaBin]:
    """Observed and predicted spread in ranges of equal count of level, slope, edge distance and radius."""
    rows: list[SigmaBin] = []
    maps = [covariate_maps(scan) for scan in scans]
    usable = [np.isfinite(residual) for residual in residuals_nm]
    residual = np.concatenate([r[use] for r, use in zip(residuals_nm, usable, strict=True)])
    sigma = np.concatenate([s[use] for s, use in zip(sigmas_nm, usable, strict=True)])
    for name in ("level", "slope", "edge distance", "radius²", "radius⁴"):
        number = COVARIATES.index(name)
        values = np.concatenate([m[number][use] for m, use in zip(maps, usable, strict=True)])
        limits = np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)))
        for low, high in pairwise(limits):
            last = high == limits[-1]
            inside = (values >= low) & ((values <= high) if last else (values < high))
            if inside.sum() < 2:
                continue
            rows.append(
                SigmaBin(
                    covariate=name,
                    low=float(low),
                    high=float(high),
                    pixels=int(inside.sum()),
                    rms_nm=float(np.sqrt(np.mean(residual[inside] ** 2))),
                    predicted_nm=float(np.sqrt(np.mean(sigma[inside] ** 2))),
                )
            )
    return rows
