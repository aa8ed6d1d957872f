"""Is what is left structured? Tests that ask for positive evidence shared between scans.

Roughness is correlated from pixel to pixel without being explainable, so closeness alone is no
evidence; a residual that follows the layout or the place in the same way in many scans is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.linear import without_scan_terms
from litho_models.loop.prepared import PreparedScan
from litho_models.scoring.statistics import family_wise_p, sign_flip_statistics, smallest_flip_p

BINS = 8
# Cells of the scan along y and along x.
_CELLS, PLACE = 8, "cell of the scan (8 × 8)"
STENCIL_PX = (-6, -3, 0, 3, 6)
STRUCTURED_P = 0.05
STRUCTURED_SHARE = 0.01
LINEAR_RESPONSE = "layout displaced by up to 0.6 µm"


@dataclass(frozen=True)
class CovariateTest:
    """Mean residual along one covariate: ``curve_nm`` over ``centres``, sign-flip p over scans.

    ``error_nm``: standard error of the curve, from the spread over scans.

    ``share``: part of the residual's squared error that the curve carries, noise taken off.
    """

    name: str
    centres: np.ndarray
    curve_nm: np.ndarray
    error_nm: np.ndarray
    p: float
    share: float


def covariate_tests(scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray]) -> list[CovariateTest]:
    """Test the residual at the sampled pixels against level, slopes, surroundings and place."""
    cleaned = []
    for scan, prediction in zip(scans, predictions, strict=True):
        residual = scan.height - scan.at_sample(prediction)
        cleaned.append(without_scan_terms(residual, scan, prediction))
    covariates = [_covariates(f, p) for f, p in zip(scans, predictions, strict=True)]
    tests = []
    for name in covariates[0] if covariates else ():
        values = [c[name] for c in covariates]
        # Bins that hold about as many pixels each.
        edges = np.unique(np.quantile(np.concatenate(values), np.linspace(0, 1, BINS + 1)))
        tests.append(_binned(name, values, edges, cleaned))
    tests.append(_binned(PLACE, [_cell(f) for f in scans], np.arange(_CELLS**2 + 1) - 0.5, cleaned))
    tests.append(_stencil(scans, cleaned, predictions))
    return tests


def is_structured(tests: Sequence[CovariateTest]) -> list[CovariateTest]:
    """The covariates with evidence: Bonferroni p <= 0.05 and at least 1 % of the squared error."""
    return [t for t in tests if t.p * len(tests) <= STRUCTURED_P and t.share >= STRUCTURED_SHARE]


def fewest_scans_for_structure(tests: int) -> int:
    """With fewer scans no residual is structured: the sign flips of none of so many tests are rare enough."""
    return next(count for count in range(2, 64) if smallest_flip_p(count) * tests <= STRUCTURED_P)


def _covariates(scan: PreparedScan, prediction: np.ndarray) -> dict[str, np.ndarray]:
    layout = np.asarray(scan.stored.layout_um, np.float64)
    slopes = np.gradient(prediction.astype(np.float64), scan.stored.pitch_um)
    along_y, along_x = (scan.at_sample(np.asarray(slope)) for slope in slopes)
    near = gaussian_filter(layout, 1.0 / scan.stored.pitch_um, mode="nearest")
    far = gaussian_filter(layout, 3.0 / scan.stored.pitch_um, mode="nearest")
    y, x = scan.position
    return {
        "level": scan.at_sample(layout) / scan.stored.level_height_um,
        "slope along x (µm/µm)": np.abs(along_x),
        "slope along y (µm/µm)": np.abs(along_y),
        "signed slope along x (µm/µm)": along_x,
        "signed slope along y (µm/µm)": along_y,
        "height above surroundings of 1 µm (µm)": scan.at_sample(np.asarray(layout - near)),
        "mean layout within 3 µm (µm)": scan.at_sample(far),
        "x over the scan": x,
        "y over the scan": y,
    }


def _cell(scan: PreparedScan) -> np.ndarray:
    """Number of the cell of the scan that holds each sampled pixel, row by row."""
    row, column = np.floor((scan.position + 1) / 2 * _CELLS).clip(0, _CELLS - 1)
    return row * _CELLS + column


def _binned(
    name: str, covariate: list[np.ndarray], edges: np.ndarray, residuals: list[np.ndarray]
) -> CovariateTest:
    if len(edges) < 3:
        return CovariateTest(name, np.empty(0), np.empty(0), np.empty(0), 1.0, 0.0)
    count = len(edges) - 1
    bins = [np.clip(np.searchsorted(edges, c, side="right") - 1, 0, count - 1) for c in covariate]
    pixels = np.stack([np.bincount(b, minlength=count) for b in bins])
    sums = np.stack([np.bincount(b, r, minlength=count) for b, r in zip(bins, residuals, strict=True)])
    p = _joint_p(sums)
    total = np.maximum(pixels.sum(axis=0), 1)
    curve = sums.sum(axis=0) / total
    noise = (sums**2).sum(axis=0) / total**2
    squared = sum(float((r**2).sum()) for r in residuals)
    share = float((np.maximum(curve**2 - noise, 0) * total).sum() / max(squared, 1e-300))
    middle = np.concatenate(covariate)
    where = np.concatenate(bins)
    centres = np.array([middle[where == b].mean() if (where == b).any() else np.nan for b in range(count)])
    return CovariateTest(name, centres, curve * NM_PER_UM, np.sqrt(noise) * NM_PER_UM, p, share)


def _stencil(
    scans: Sequence[PreparedScan], residuals: Sequence[np.ndarray], predictions: Sequence[np.ndarray]
) -> CovariateTest:
    """Linear response to the layout at a grid of displacements: a kernel that the model lacks."""
    offsets = [(dy, dx) for dy in STENCIL_PX for dx in STENCIL_PX]
    grams = []
    for scan, residual, prediction in zip(scans, residuals, predictions, strict=True):
        layout = scan.stored.layout_um.astype(np.float64)
        columns = np.stack(
            [scan.at_sample(np.roll(layout, (-dy, -dx), (0, 1))) for dy, dx in offsets] + [residual], axis=1
        )
        columns = without_scan_terms(columns, scan, prediction)
        grams.append(columns.T @ columns)
    stacked = np.stack(grams)
    p = _joint_p(stacked[:, :-1, -1])
    pooled = stacked.sum(axis=0)
    normal = pooled[:-1, :-1] + 1e-3 * np.trace(pooled[:-1, :-1]) / len(offsets) * np.eye(len(offsets))
    # Held out by scan: the kernel of the other scans, judged on this one.
    gain = 0.0
    for own in stacked:
        kernel = np.linalg.solve(normal - own[:-1, :-1], pooled[:-1, -1] - own[:-1, -1])
        gain += 2 * kernel @ own[:-1, -1] - kernel @ own[:-1, :-1] @ kernel
    share = max(0.0, float(gain / max(pooled[-1, -1], 1e-300))) if len(scans) > 1 else 0.0
    return CovariateTest(LINEAR_RESPONSE, np.empty(0), np.empty(0), np.empty(0), p, share)


def _joint_p(sums: np.ndarray) -> float:
    """Sign-flip p of the largest |z| over the columns of (scans, columns)."""
    informative = sums[:, (sums**2).sum(axis=0) > 0]
    if informative.shape[1] == 0:
        return 1.0
    z, null_max = sign_flip_statistics(informative)
    return family_wise_p(float(np.abs(z).max()), null_max)
