"""Is a stated σ right? Judged scan by scan, with a variance fitted on other scans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_models.noise.spread_scores import (
    COVERAGE_LEVELS,
    coverage,
    crps,
    half_width,
    negative_log_likelihood,
    normalised_calibration_error,
    probability_below,
    sparsification_error,
)
from litho_models.noise.variance import (
    SigmaBin,
    VarianceModel,
    covariate_maps,
    fit_log_variance,
    sigma_bins,
    sigma_nm,
    variance_model,
)
from litho_models.scan_terms import NuisanceProtocol

_FOLDS = 5
_PIXELS_PER_SCAN = 20_000
_PIT_BINS = 20
# Share of scans that the scan-level factor promises to hold; it takes nine scans to promise 90 %.
CONFORMAL_LEVEL = 0.9


class ScanCalibration(Record):
    """One scan: likelihood and CRPS (nm, lower is better), coverage at 50, 80, 90, 95 %, rms of r/σ.

    ``factor_90`` is what σ has to be multiplied by for 90 % of this scan's pixels to be covered; ``ence`` and
    ``ause`` are shares (see ``spread_scores``), None in older result files.
    """

    scan: str
    nll: float
    crps_nm: float
    coverage: list[float]
    standardised_rms: float
    factor_90: float
    ence: float | None = None
    ause: float | None = None


class Calibration(Record):
    """A description of the spread and how it holds on scans it was not fitted on.

    Args:
        name: constant, by covariates, or with the ensemble's disagreement added.
        nll, crps_nm, coverage, ence, ause: means over scans; ``levels`` are what the coverages should be.
        pit: histogram of Φ(r/σ) in 20 equal bins, sums to one; flat if the shape is Gaussian.
        conformal_factor: σ times this covers 90 % of the pixels in 90 % of new scans, the scan being
            the exchangeable unit; None with fewer than nine scans.
    """

    name: str
    levels: list[float]
    nll: float
    crps_nm: float
    coverage: list[float]
    worst_scan_coverage_90: float
    pit: list[float]
    conformal_factor: float | None
    scans: list[ScanCalibration]
    ence: float | None = None
    ause: float | None = None


class SpreadAnalysis(Record):
    """σ(x) of one model's residuals and its calibration; ``bins`` are out of fold, the model is of all.

    ``nuisance``: what the residuals were freed of; an offset only in older result files.
    """

    model: str
    members: int
    held_out: bool
    residual_rms_nm: float
    residual_mae_nm: float
    epistemic_rms_nm: float | None
    variance: VarianceModel
    bins: list[SigmaBin]
    calibrations: list[Calibration]
    nuisance: NuisanceProtocol = Field(default_factory=NuisanceProtocol)


class Residuals(NamedTuple):
    """Out-of-fold residuals of one model: scans, measured minus predicted (nm, NaN where not scored), and
    the standard deviation of the members' predictions (nm), None for a single one; ``protocol`` is what the
    residuals were freed of."""

    model: str
    scans: Sequence[PrintedScan]
    residuals_nm: Sequence[np.ndarray]
    disagreement_nm: Sequence[np.ndarray] | None
    members: int
    held_out: bool
    protocol: NuisanceProtocol = NuisanceProtocol()


def analyse_spread(found: Residuals, seed: int = 0) -> SpreadAnalysis:
    """Fit a constant and a covariate variance out of fold by scan, and judge both on the scans left out.

    Raises:
        InputError: fewer than three scans.
    """
    scans, residuals = found.scans, found.residuals_nm
    if len(scans) < 3:
        raise InputError("scans for a calibration", got=len(scans), wanted="at least 3, to leave some out")
    maps = [np.moveaxis(covariate_maps(scan), 0, -1) for scan in scans]
    samples = [_sample(residual, seed + number) for number, residual in enumerate(residuals)]
    chosen = [(m[s], r[s]) for m, r, s in zip(maps, residuals, samples, strict=True)]
    fold = np.arange(len(scans)) % min(_FOLDS, len(scans))
    constant: list[np.ndarray] = [np.empty(0)] * len(scans)
    by_covariates: list[np.ndarray] = [np.empty(0)] * len(scans)
    for number in range(fold.max() + 1):
        learned = [chosen[i] for i in np.flatnonzero(fold != number)]
        design = np.concatenate([part[0] for part in learned])
        residual = np.concatenate([part[1] for part in learned])
        beta = fit_log_variance(design, residual)
        for held_out in np.flatnonzero(fold == number).tolist():
            constant[held_out] = np.full(scans[held_out].shape, np.sqrt(np.mean(residual**2)))
            by_covariates[held_out] = sigma_nm(beta, maps[held_out])
    calibrations = [
        calibrate("constant", scans, residuals, constant),
        calibrate("by covariates", scans, residuals, by_covariates),
    ]
    epistemic = None
    if found.disagreement_nm is not None:
        total = [np.hypot(s, d) for s, d in zip(by_covariates, found.disagreement_nm, strict=True)]
        calibrations.append(calibrate("by covariates, disagreement added", scans, residuals, total))
        epistemic = float(np.sqrt(np.mean([np.mean(d**2) for d in found.disagreement_nm])))
    finite = np.concatenate([residual[np.isfinite(residual)] for residual in residuals])
    everything = fit_log_variance(*(np.concatenate([part[i] for part in chosen]) for i in (0, 1)))
    return SpreadAnalysis(
        model=found.model,
        members=found.members,
        held_out=found.held_out,
        residual_rms_nm=float(np.sqrt(np.mean(finite**2))),
        residual_mae_nm=float(np.abs(finite).mean()),
        epistemic_rms_nm=epistemic,
        variance=variance_model(everything),
        bins=sigma_bins(scans, residuals, by_covariates),
        calibrations=calibrations,
        nuisance=found.protocol,
    )


def calibrate(
    name: str,
    scans: Sequence[PrintedScan],
    residuals_nm: Sequence[np.ndarray],
    sigmas_nm: Sequence[np.ndarray],
) -> Calibration:
    """Judge a stated σ on every scan; pixels first, then scans."""
    rows = []
    histogram = np.zeros(_PIT_BINS)
    for scan, residual, sigma in zip(scans, residuals_nm, sigmas_nm, strict=True):
        scored = np.isfinite(residual)
        r, s = residual[scored], sigma[scored]
        counts = np.histogram(probability_below(r / s), bins=_PIT_BINS, range=(0, 1))[0]
        histogram += counts / counts.sum()
        rows.append(
            ScanCalibration(
                scan=scan.id,
                nll=float(negative_log_likelihood(r, s).mean()),
                crps_nm=float(crps(r, s).mean()),
                coverage=[coverage(r, s, level) for level in COVERAGE_LEVELS],
                standardised_rms=float(np.sqrt(np.mean((r / s) ** 2))),
                factor_90=float(np.quantile(np.abs(r / s), 0.9) / half_width(0.9)),
                ence=normalised_calibration_error(r, s),
                ause=sparsification_error(r, s),
            )
        )
    shares = np.array([row.coverage for row in rows])
    return Calibration(
        name=name,
        levels=list(COVERAGE_LEVELS),
        nll=float(np.mean([row.nll for row in rows])),
        crps_nm=float(np.mean([row.crps_nm for row in rows])),
        coverage=shares.mean(axis=0).tolist(),
        worst_scan_coverage_90=float(shares[:, COVERAGE_LEVELS.index(0.9)].min()),
        pit=(histogram / len(rows)).tolist(),
        conformal_factor=conformal_factor([row.factor_90 for row in rows]),
        scans=rows,
        ence=float(np.mean([row.ence for row in rows])),
        ause=float(np.mean([row.ause for row in rows])),
    )


def conformal_factor(factors: Sequence[float], level: float = CONFORMAL_LEVEL) -> float | None:
    """The ⌈(n + 1) level⌉-th smallest factor of n scans: a new scan needs no more with probability ``level``.

    None where n is too small to promise it (n < level / (1 − level)).
    """
    # 0.9 · 10 is 9.000000000000002 in floating point.
    rank = int(np.ceil(round((len(factors) + 1) * level, 9)))
    return None if rank > len(factors) else float(np.sort(factors)[rank - 1])


def _sample(residual: np.ndarray, seed: int) -> tuple[np.ndarray, ...]:
    """Row and column indices of at most 20,000 scored pixels."""
    scored = np.flatnonzero(np.isfinite(residual))
    if scored.size > _PIXELS_PER_SCAN:
        scored = np.random.default_rng(seed).choice(scored, _PIXELS_PER_SCAN, replace=False)
    return np.unravel_index(scored, residual.shape)
