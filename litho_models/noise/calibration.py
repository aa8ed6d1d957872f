"""Test whether a stated spread (standard deviation) of the residuals is calibrated. The test uses prints that
were not used to fit the spread.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_models.noise.residuals import Pool, Residuals
from litho_models.noise.spread_scores import (
    COVERAGE_LEVELS,
    GAUSSIAN,
    Tails,
    equal_counts,
    normalised_calibration_error,
    sparsification_error,
)
from litho_models.noise.variance import (
    PLACES,
    VarianceModel,
    covariates_of,
    fit_spread,
    place_maps,
    scale_nm,
    variance_model,
)
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.statistics import Interval, rms

_FOLDS = 5
# Number of pixels of each scan that are used in the fit. Roughness is correlated over distances of ten pixels
# and more, so more pixels would add hardly any information.
_PIXELS_PER_SCAN = 5000
_PIT_BINS = 20
_BINS = 8
_MEANS = ("nll", "crps_nm", "ence", "ause")


class ScanCalibration(Record):
    """The scores of a stated spread on one scan.

    ``nll`` is the negative log-likelihood, and ``crps_nm`` is the continuous ranked probability score. For
    both, lower is better. ``coverage`` is the share of residuals inside the stated intervals, for each level
    in ``Calibration.levels``. ``standardised_rms`` is the rms over the pixels of this ratio: residual divided
    by stated standard deviation.

    ``ence`` and ``ause`` are fractions, for which 0 is best (see ``spread_scores``).
    """

    scan: str
    nll: float
    crps_nm: float
    coverage: list[float]
    standardised_rms: float
    ence: float
    ause: float


class Calibration(Record):
    """The calibration of one model of the spread, on prints that were not used to fit it.

    Args:
        name: whether the spread is constant or depends on covariates.
        levels: nominal coverages of the intervals. For a calibrated spread, ``coverage`` equals ``levels``.
        nll, crps_nm, coverage, ence, ause: means over scans of the fields of ``ScanCalibration`` with the
            same names.
        pit: histogram of the probability integral transform. For each pixel, the transform is the stated
            probability that a residual is below the observed residual. The 20 bins add up to one. If the
            stated distribution is right, the histogram is flat.
    """

    name: str
    levels: list[float]
    nll: float
    crps_nm: float
    coverage: list[float]
    worst_scan_coverage_90: float
    pit: list[float]
    scans: list[ScanCalibration]
    ence: float
    ause: float


class SigmaBin(Record):
    """Results for the pixels at which a covariate lies in a given range: the measured and the predicted
    spread of the residual, and the coverage of the stated intervals.

    The coverage is stated for the 68 % and the 95 % interval. Each coverage has a 95 % confidence interval
    from resampling prints. ``ence`` and ``ause`` are computed from the pixels in this range.
    """

    covariate: str
    low: float
    high: float
    pixels: int
    rms_nm: float
    predicted_nm: float
    coverage_68: float
    coverage_68_ci95: Interval
    coverage_95: float
    coverage_95_ci95: Interval
    ence: float
    ause: float


class SpreadAnalysis(Record):
    """The spread σ(x) of the residuals of one model, and its calibration. ``bins`` is computed on scans that
    were not used to fit the spread. ``variance`` is the model of the spread, fitted to all scans.

    ``nuisance`` names the terms that were removed from the residuals. For each test, the spread is fitted
    anew without the data on which it is tested. ``left_out`` says whether these data are all scans of one
    print (``prints``) or a group of scans (``scans``).
    """

    model: str
    held_out: bool
    residual_rms_nm: float
    residual_mae_nm: float
    variance: VarianceModel
    bins: list[SigmaBin]
    calibrations: list[Calibration]
    nuisance: NuisanceProtocol = Field(default_factory=NuisanceProtocol)
    left_out: str = "scans"


class Stated(NamedTuple):
    """The distribution that a model of the noise predicts for the residuals of one scan. ``scale_nm`` is its
    scale at each pixel, and ``tails`` is the shape of the distribution.
    """

    scale_nm: Array
    tails: Tails


def analyse_spread(found: Residuals, seed: int = 0) -> SpreadAnalysis:
    """Fit and test two models of the spread of the residuals: a constant spread, and a spread that depends on
    covariates. For each print, both models are fitted to all other prints and tested on this print.

    If there are fewer than three prints, the scans are divided into up to five groups, and each group takes
    the place of a print. The constant spread is the rms of the residuals, with a Gaussian distribution. In
    the other model, the shape of the distribution is fitted together with the spread.

    Raises:
        InputError: there are fewer than three scans.
    """
    scans, residuals = found.scans, found.residuals_nm
    if len(scans) < 3:
        raise InputError(
            "scans to fit and judge a spread",
            got=len(scans),
            wanted="at least 3, so that some can be left out of the fit",
        )
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
    fits = {}
    for number in np.unique(fold).tolist():
        learned = np.flatnonzero(fold != number)
        residual = np.concatenate([samples[i] for i in learned])
        fits[number] = rms(residual), fit_spread(np.concatenate([designs[i] for i in learned]), residual)
    constant, by_covariates = [], []
    for number, place in zip(fold.tolist(), places, strict=True):
        flat, (beta, tails) = fits[number]
        scale = scale_nm(beta, covariates_of(place))
        by_covariates.append(Stated(scale, tails))
        constant.append(Stated(np.full_like(scale, flat), GAUSSIAN))
    finite = np.concatenate([residual[np.isfinite(residual)] for residual in residuals])
    return SpreadAnalysis(
        model=found.model,
        held_out=found.held_out,
        residual_rms_nm=rms(finite),
        residual_mae_nm=float(np.abs(finite).mean()),
        variance=variance_model(*fit_spread(np.concatenate(designs), np.concatenate(samples))),
        bins=list(_bins(scans, places, residuals, by_covariates)),
        calibrations=[
            calibrate("constant", scans, residuals, constant),
            calibrate("by covariates", scans, residuals, by_covariates),
        ],
        nuisance=found.protocol,
        left_out="prints" if by_print else "scans",
    )


def calibrate(
    name: str, scans: Sequence[PrintedScan], residuals_nm: Sequence[Array], stated: Sequence[Stated]
) -> Calibration:
    """Compute the calibration of a stated spread on every scan, and average the results over the scans."""
    rows, histograms = [], []
    for scan, residual, (scale, tails) in zip(scans, residuals_nm, stated, strict=True):
        scored = np.isfinite(residual)
        r, s = residual[scored], scale[scored]
        counts = np.histogram(tails.probability_below(r / s), bins=_PIT_BINS, range=(0, 1))[0]
        histograms.append(counts / counts.sum())
        rows.append(
            ScanCalibration(
                scan=scan.id,
                nll=float(-tails.log_likelihood(r, s).mean()),
                crps_nm=float(tails.crps(r, s).mean()),
                coverage=[float(tails.covered(r, s, level).mean()) for level in COVERAGE_LEVELS],
                standardised_rms=rms(r / s) / tails.sd,
                ence=normalised_calibration_error(r, tails.sd * s),
                ause=sparsification_error(r, s),
            )
        )
    shares = np.array([row.coverage for row in rows])
    return Calibration(
        name=name,
        levels=list(COVERAGE_LEVELS),
        **{name: float(np.mean([getattr(row, name) for row in rows])) for name in _MEANS},
        coverage=shares.mean(axis=0).tolist(),
        worst_scan_coverage_90=float(shares[:, COVERAGE_LEVELS.index(0.9)].min()),
        pit=np.mean(histograms, axis=0).tolist(),
        scans=rows,
    )


def _bins(
    scans: Sequence[PrintedScan],
    places: Sequence[dict[str, Array]],
    residuals_nm: Sequence[Array],
    stated: Sequence[Stated],
) -> Iterator[SigmaBin]:
    """Yield the results for groups of pixels. There is one group with all pixels and one group for each
    level. For every other covariate, there are several groups with equal numbers of pixels.
    """
    pool = Pool(scans, [np.isfinite(residual) for residual in residuals_nm])
    residual = pool.of(residuals_nm)
    sigma = pool.of([own.tails.sd * own.scale_nm for own in stated])
    inside = {
        share: pool.of(
            [
                own.tails.covered(r, own.scale_nm, share / 100)
                for r, own in zip(residuals_nm, stated, strict=True)
            ]
        )
        for share in (68, 95)
    }
    for covariate, low, high, mine in _groups(pool, places):
        if not residual[mine].any():
            continue
        coverage: dict[str, Any] = {}
        for share, within in inside.items():
            coverage[f"coverage_{share}"] = float(within[mine].mean())
            coverage[f"coverage_{share}_ci95"] = pool.interval(within, mine)
        yield SigmaBin(
            covariate=covariate,
            low=low,
            high=high,
            pixels=int(mine.sum()),
            rms_nm=rms(residual[mine]),
            predicted_nm=rms(sigma[mine]),
            ence=normalised_calibration_error(residual[mine], sigma[mine]),
            ause=sparsification_error(residual[mine], sigma[mine]),
            **coverage,
        )


def _groups(pool: Pool, places: Sequence[dict[str, Array]]) -> Iterator[tuple[str, float, float, Array]]:
    """Yield each group of pixels as a tuple. It contains the name of the covariate, the lowest and highest
    value of this covariate in the group, and a mask of the group's pixels.
    """
    level = pool.of([scan.mask_level for scan in pool.scans])
    yield "all", 0, 0, np.ones(level.size, bool)
    for one in np.unique(level).tolist():
        yield "level", one, one, level == one
    for name in PLACES[1:]:
        limits, number = equal_counts(pool.of([own[name] for own in places]), _BINS)
        for at, (low, high) in enumerate(pairwise(limits.tolist())):
            yield name, low, high, number == at


def _sample(residual: Array, seed: int) -> tuple[Array, ...]:
    """Return the row and column indices of at most ``_PIXELS_PER_SCAN`` scored pixels, which are chosen at
    random.
    """
    scored = np.flatnonzero(np.isfinite(residual))
    if scored.size > _PIXELS_PER_SCAN:
        scored = np.random.default_rng(seed).choice(scored, _PIXELS_PER_SCAN, replace=False)
    return np.unravel_index(scored, residual.shape)
