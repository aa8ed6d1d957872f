"""Is a stated spread right? Judged on prints that it was not fitted on."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_models.noise.residuals import Residuals
from litho_models.noise.spread_scores import (
    COVERAGE_LEVELS,
    GAUSSIAN,
    Tails,
    normalised_calibration_error,
    sparsification_error,
)
from litho_models.noise.variance import (
    VarianceModel,
    covariates_of,
    fit_spread,
    place_maps,
    scale_nm,
    variance_model,
)
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.statistics import pixel_interval, rms

_FOLDS = 5
# Roughness is correlated over ten pixels and more, so that more pixels tell nothing new.
_PIXELS_PER_SCAN = 5000
_PIT_BINS = 20
_BINS = 8
# Coverage levels at which groups of pixels are judged: one and two σ of a Gaussian.
_GROUP_LEVELS = (0.68, 0.95)
# Share of scans that the scan-level factor promises to hold; it takes nine scans to promise 90 %.
CONFORMAL_LEVEL = 0.9
_MEANS = ("nll", "crps_nm", "ence", "ause")


class ScanCalibration(Record):
    """One scan: likelihood and CRPS (nm, lower is better), coverage at the levels stated, rms of r/σ.

    ``factor_90``: factor on the scale with which 90 % of this scan's pixels are covered;
    ``ence`` and ``ause`` are shares (see ``spread_scores``), None in older result files.
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
    """A description of the spread and how well it holds on prints that it was not fitted on.

    Args:
        name: constant, by covariates, or with the ensemble's disagreement added.
        nll, crps_nm, coverage, ence, ause: means over scans; ``levels`` are what the coverages should be.
        pit: histogram of the stated probability below r/s, 20 bins, sums to one; flat if the shape is right.
        conformal_factor: scale times this covers 90 % of the pixels in 90 % of new scans, the scan being
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


class SigmaBin(Record):
    """Pixels within one range of one covariate: measured and predicted spread, and how far the latter holds.

    Coverage at 68 and 95 % with 95 % intervals over prints; ENCE and AUSE within the group. None in older
    result files, whose levels are shares of the range.
    """

    covariate: str
    low: float
    high: float
    pixels: int
    rms_nm: float
    predicted_nm: float
    coverage_68: float | None = None
    coverage_68_ci95: tuple[float, float] | None = None
    coverage_95: float | None = None
    coverage_95_ci95: tuple[float, float] | None = None
    ence: float | None = None
    ause: float | None = None


class SpreadAnalysis(Record):
    """σ(x) of one model's residuals and its calibration; ``bins`` are out of fold, the model is of all scans.

    ``nuisance``: what the residuals were freed of; in older result files an offset only. ``left_out``: the
    prints or scans that are left out of each fit to judge it.
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
    left_out: str = "scans"


class Stated(NamedTuple):
    """The stated distribution of one scan's residual: its scale at each pixel, nm, and its shape."""

    scale_nm: Array
    tails: Tails


def analyse_spread(found: Residuals, seed: int = 0) -> SpreadAnalysis:
    """Fit a constant and a covariate spread without each print, and judge both on the prints left out.

    With fewer than three prints scans are left out instead. The tails are chosen with the scale, on the
    prints that both are fitted to.

    Raises:
        InputError: fewer than three scans.
    """
    scans, residuals = found.scans, found.residuals_nm
    if len(scans) < 3:
        raise InputError("scans for a calibration", got=len(scans), wanted="at least 3, to leave some out")
    places = [place_maps(scan) for scan in scans]
    drawn = [_sample(residual, seed + number) for number, residual in enumerate(residuals)]
    designs = [
        covariates_of({name: field[at] for name, field in own.items()})
        for own, at in zip(places, drawn, strict=True)
    ]
    samples = [residual[at] for residual, at in zip(residuals, drawn, strict=True)]
    prints = [scan.print_id for scan in scans]
    by_print = len(set(prints)) > 2
    fold = np.unique(prints, return_inverse=True)[1] if by_print else np.arange(len(scans)) % _FOLDS
    constant, by_covariates = ([Stated(np.empty(0), GAUSSIAN)] * len(scans) for _ in range(2))
    for number in np.unique(fold):
        learned = np.flatnonzero(fold != number)
        residual = np.concatenate([samples[i] for i in learned])
        flat = rms(residual)
        beta, tails = fit_spread(np.concatenate([designs[i] for i in learned]), residual)
        for i in np.flatnonzero(fold == number).tolist():
            constant[i] = Stated(np.full(scans[i].shape, flat), GAUSSIAN)
            by_covariates[i] = Stated(scale_nm(beta, covariates_of(places[i])), tails)
    stated = {"constant": constant, "by covariates": by_covariates}
    epistemic = None
    if found.disagreement_nm is not None:
        stated["by covariates, disagreement added"] = [
            Stated(np.hypot(own.scale_nm, apart), own.tails)
            for own, apart in zip(by_covariates, found.disagreement_nm, strict=True)
        ]
        epistemic = rms([rms(apart) for apart in found.disagreement_nm])
    finite = np.concatenate([residual[np.isfinite(residual)] for residual in residuals])
    return SpreadAnalysis(
        model=found.model,
        members=found.members,
        held_out=found.held_out,
        residual_rms_nm=rms(finite),
        residual_mae_nm=float(np.abs(finite).mean()),
        epistemic_rms_nm=epistemic,
        variance=variance_model(*fit_spread(np.concatenate(designs), np.concatenate(samples))),
        bins=_bins(scans, places, residuals, by_covariates),
        calibrations=[calibrate(name, scans, residuals, own) for name, own in stated.items()],
        nuisance=found.protocol,
        left_out="prints" if by_print else "scans",
    )


def calibrate(
    name: str, scans: Sequence[PrintedScan], residuals_nm: Sequence[Array], stated: Sequence[Stated]
) -> Calibration:
    """Judge a stated spread on every scan; pixels first, then scans."""
    rows = []
    histogram = np.zeros(_PIT_BINS)
    for scan, residual, (scale, tails) in zip(scans, residuals_nm, stated, strict=True):
        scored = np.isfinite(residual)
        r, s = residual[scored], scale[scored]
        counts = np.histogram(tails.probability_below(r / s), bins=_PIT_BINS, range=(0, 1))[0]
        histogram += counts / counts.sum()
        rows.append(
            ScanCalibration(
                scan=scan.id,
                nll=float(-tails.log_likelihood(r, s).mean()),
                crps_nm=float(tails.crps(r, s).mean()),
                coverage=[float(tails.covered(r, s, level).mean()) for level in COVERAGE_LEVELS],
                standardised_rms=rms(r / s) / tails.sd,
                factor_90=float(np.quantile(np.abs(r / s), 0.9) / tails.half_width(0.9)),
                ence=normalised_calibration_error(r, tails.sd * s),
                ause=sparsification_error(r, s),
            )
        )
    shares = np.array([row.coverage for row in rows])
    return Calibration(
        name=name,
        levels=list(COVERAGE_LEVELS),
        **{figure: float(np.mean([getattr(row, figure) for row in rows])) for figure in _MEANS},
        coverage=shares.mean(axis=0).tolist(),
        worst_scan_coverage_90=float(shares[:, COVERAGE_LEVELS.index(0.9)].min()),
        pit=(histogram / len(rows)).tolist(),
        conformal_factor=conformal_factor([row.factor_90 for row in rows]),
        scans=rows,
    )


def _bins(
    scans: Sequence[PrintedScan],
    places: Sequence[dict[str, Array]],
    residuals_nm: Sequence[Array],
    stated: Sequence[Stated],
) -> list[SigmaBin]:
    """All pixels, each level, and ranges of equal count of what else the spread depends on."""
    used = [np.isfinite(residual) for residual in residuals_nm]

    def pooled(maps: Sequence[Array]) -> Array:
        return np.concatenate([field[use] for field, use in zip(maps, used, strict=True)])

    residual = pooled(residuals_nm)
    sigma = pooled([own.tails.sd * own.scale_nm for own in stated])
    owner = np.repeat(np.arange(len(scans)), [int(use.sum()) for use in used])
    inside = [
        pooled(
            [own.tails.covered(r, own.scale_nm, level) for r, own in zip(residuals_nm, stated, strict=True)]
        )
        for level in _GROUP_LEVELS
    ]
    prints = [scan.print_id for scan in scans]

    def judged(covariate: str, low: float, high: float, mine: Array) -> SigmaBin:
        coverage = [float(within[mine].mean()) for within in inside]
        intervals = [pixel_interval(within[mine], owner[mine], prints) for within in inside]
        return SigmaBin(
            covariate=covariate,
            low=low,
            high=high,
            pixels=int(mine.sum()),
            rms_nm=rms(residual[mine]),
            predicted_nm=rms(sigma[mine]),
            coverage_68=coverage[0],
            coverage_68_ci95=intervals[0],
            coverage_95=coverage[1],
            coverage_95_ci95=intervals[1],
            ence=normalised_calibration_error(residual[mine], sigma[mine]),
            ause=sparsification_error(residual[mine], sigma[mine]),
        )

    rows = [judged("all", 0, 0, np.ones(residual.size, bool))]
    levels = pooled([scan.mask_level for scan in scans])
    for level in np.unique(levels).tolist():
        mine = levels == level
        if residual[mine].any():
            rows.append(judged("level", level, level, mine))
    for name in ("slope", "edge distance", "radius²"):
        values = pooled([own[name] for own in places])
        limits = np.unique(np.quantile(values, np.linspace(0, 1, _BINS + 1)))
        for low, high in pairwise(limits.tolist()):
            mine = (values >= low) & ((values <= high) if high == limits[-1] else (values < high))
            if residual[mine].any():
                rows.append(judged(name, low, high, mine))
    return rows


def conformal_factor(factors: Sequence[float], level: float = CONFORMAL_LEVEL) -> float | None:
    """The ⌈(n + 1) level⌉-th smallest factor of n scans: a new scan needs no more with probability ``level``.

    None where n is too small to promise it (n < level / (1 − level)).
    """
    # 0.9 · 10 is 9.000000000000002 in floating point.
    rank = int(np.ceil(round((len(factors) + 1) * level, 9)))
    return None if rank > len(factors) else float(np.sort(factors)[rank - 1])


def _sample(residual: Array, seed: int) -> tuple[Array, ...]:
    """Row and column indices of at most ``_PIXELS_PER_SCAN`` scored pixels."""
    scored = np.flatnonzero(np.isfinite(residual))
    if scored.size > _PIXELS_PER_SCAN:
        scored = np.random.default_rng(seed).choice(scored, _PIXELS_PER_SCAN, replace=False)
    return np.unravel_index(scored, residual.shape)
