"""Estimate the noise floor of a dataset, which is the smallest error that any model can have. There is one
floor for each policy, i.e. for each set of per-scan terms that may be fitted.

If there are flat or repeated prints, the floor is measured on them. Otherwise it is estimated from the
residuals of a model on held-out scans, by comparing pixels with similar surroundings (``like_layouts``).
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record, Result
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_data.store.schema import DatasetId
from litho_models.scan_terms import POLICIES, Blocks, CrossFit, Policy, cross_fit
from litho_models.scoring.like_layouts import LikePixels, like_pixels
from litho_models.scoring.statistics import Interval, pixel_interval

NOISE_FILE = "noise.json"


class PolicyFloor(Record):
    """The noise floor for one nuisance policy (set of per-scan terms), nm, with 95 % confidence intervals
    from resampling prints.

    ``k`` is the number of terms that are fitted to each scan. For a policy with line offsets, ``k`` is the
    effective number of terms. The intervals are None if there are fewer than six prints.
    """

    policy: Policy
    k: float
    mae_nm: float
    mae_ci95_nm: Interval
    rmse_nm: float
    rmse_ci95_nm: Interval


class NoiseFloor(Record):
    """The noise floor: the error that noise alone causes, nm. ``kind`` says how the floor was estimated, and
    ``source`` says from what or, if the floor is unknown, why.

    ``mae_nm`` and ``rmse_nm`` are the floors of the mean absolute and the root-mean-square error for the
    policy ``offset``, i.e. after an offset is fitted to each scan. ``by_policy`` contains the floors for each
    policy. It is empty if only the floor for the policy ``offset`` is known.
    """

    mae_nm: float | None
    rmse_nm: float | None
    kind: Literal["measured", "upper-estimate", "unknown"]
    source: str
    by_policy: list[PolicyFloor] = Field(default_factory=list)

    def at(self, policy: str) -> PolicyFloor | None:
        """Return the noise floor for the given policy. Return None if it is unknown."""
        return next((row for row in self.by_policy if row.policy == policy), None)

    def mae_at(self, policy: str) -> float | None:
        """Return the floor of the mean absolute error for the given policy, nm, or None if it is unknown."""
        row = self.at(policy)
        return row.mae_nm if row else self.mae_nm if policy == "offset" else None


UNKNOWN_FLOOR = NoiseFloor(
    mae_nm=None,
    rmse_nm=None,
    kind="unknown",
    source="there are no flat or repeated prints, and no out-of-fold residuals of three scans with the same "
    "dose",
)


class _StatedFloor(Result, extra="ignore"):
    """The parts of ``noise.json`` that this module reads: the dataset and the noise floor."""

    SCHEMA = "litho-models/noise/1"
    FILE_NAME = NOISE_FILE

    dataset: DatasetId | None
    noise_floor: NoiseFloor


def stated_floor(dataset_name: str, analysis: str | Path | None) -> NoiseFloor:
    """Return the noise floor that a noise analysis states. If no analysis is given, the returned record says
    that the floor is unknown.

    Args:
        dataset_name: name of the dataset for which errors are reported.
        analysis: path of a ``noise.json`` or of its folder. The analysis must have been made from this
            dataset, or from files of single scans.

    Raises:
        InputError: there is no noise analysis at this path, or it belongs to another dataset.
    """
    if analysis is None:
        return UNKNOWN_FLOOR
    found = _StatedFloor.read(analysis)
    if found.dataset is not None and found.dataset.name != dataset_name:
        raise InputError(f"noise analysis {analysis}", got=found.dataset.name, wanted=dataset_name)
    return found.noise_floor


def estimated_floor(
    model: str,
    scans: Sequence[PrintedScan],
    maps_um: Sequence[np.ndarray],
    blocks: Blocks | None = None,
    seed: int = 0,
) -> NoiseFloor:
    """Estimate an upper limit of the noise floor for every policy. The estimate uses the predictions of a
    model for held-out scans.

    Args:
        model: name of the model, which is stated in the field ``source`` of the result.
        scans: held-out scans.
        maps_um: height map that the model predicts for each scan, µm, of shape (ny, nx).
        blocks: division of the pixels into those to which terms are fitted and those that are scored. The
            floor is comparable only with errors that were computed with the same blocks.
        seed: decides which pixels are drawn.
    """
    return floor_of_residuals(model, scans, freed_by_policy(scans, maps_um, blocks), seed)


def freed_by_policy(
    scans: Sequence[PrintedScan],
    maps_um: Sequence[np.ndarray],
    blocks: Blocks | None = None,
    policies: Iterable[Policy] = tuple(POLICIES),
) -> dict[Policy, list[CrossFit]]:
    """For each policy (set of per-scan terms), fit its terms to each scan, subtract them, and return the
    residuals. ``maps_um`` contains the predicted map of each scan, µm, of shape (ny, nx).
    """
    return {
        policy: [
            cross_fit(scan.height_um, expected, scan.usable, POLICIES[policy], blocks)
            for scan, expected in zip(scans, maps_um, strict=True)
        ]
        for policy in policies
    }


def floor_of_residuals(
    model: str,
    scans: Sequence[PrintedScan],
    freed: Mapping[Policy, Sequence[CrossFit]],
    seed: int = 0,
) -> NoiseFloor:
    """Estimate an upper limit of the noise floor from the residuals of a model on held-out scans.

    ``LikePixels`` estimates the noise from differences between pixels with similar surroundings. It yields
    the fraction of the squared error that is noise, in a random sample of pixels. The floor is the error over
    all scored pixels times the square root of this fraction. For the mean absolute error, this assumes that
    noise and residual have the same ratio of mean absolute value to standard deviation. The assumption is
    true if nearly all of the residual is noise, whatever the distribution of the noise. It fails, for
    example, if the noise is Gaussian and the misfit has a Laplace distribution, or the reverse. If the misfit
    then causes half of the squared error, the floor is wrong by up to 6 %.

    Args:
        model: name of the model, which is stated in the field ``source`` of the result.
        scans: held-out scans.
        freed: residuals of each scan, keyed by policy, as returned by ``freed_by_policy``. The policy
            ``offset`` must be among the keys.
        seed: decides which pixels are drawn.
    """
    # The scans are sorted by id, so that the pixels that are drawn do not depend on the order of the argument
    # ``scans``.
    order = sorted(range(len(scans)), key=lambda number: scans[number].id)
    scans = [scans[number] for number in order]
    scored = [np.isfinite(freed["offset"][number].residual_um) for number in order]
    drawn = like_pixels(scans, scored, seed)
    if drawn is None:
        return UNKNOWN_FLOOR
    prints = [scan.print_id for scan in scans]
    rows = [
        _floor(policy, drawn, [fits[number] for number in order], prints) for policy, fits in freed.items()
    ]
    offset = next(row for row in rows if row.policy == "offset")
    return NoiseFloor(
        mae_nm=offset.mae_nm,
        rmse_nm=offset.rmse_nm,
        kind="upper-estimate",
        source=f"residuals of {model} on scans that it had not seen; {len(drawn.owner):,} pixels are "
        "compared with pixels of other scans that have similar layout surroundings. Effects of layout "
        "details that are farther away or finer than those compared still count as noise",
        by_policy=rows,
    )


def _floor(policy: Policy, drawn: LikePixels, fits: Sequence[CrossFit], prints: Sequence[str]) -> PolicyFloor:
    residuals_nm = [NM_PER_UM * fit.residual_um for fit in fits]
    noise, square = drawn.noise_squared(residuals_nm)
    share = noise.mean() / square.mean() if square.any() else 0.0
    mae = float(np.mean([np.nanmean(np.abs(residual)) for residual in residuals_nm]))
    rmse = float(np.sqrt(np.mean([np.nanmean(residual**2) for residual in residuals_nm])))
    shrink = _root(share)
    interval = pixel_interval(noise / noise.mean(), drawn.owner, prints) if share > 0 else None
    low, high = (_root(share * end) for end in interval or (0.0, 0.0))
    return PolicyFloor(
        policy=policy,
        k=float(np.mean([fit.degrees_of_freedom for fit in fits])),
        mae_nm=shrink * mae,
        mae_ci95_nm=(low * mae, high * mae) if interval else None,
        rmse_nm=shrink * rmse,
        rmse_ci95_nm=(low * rmse, high * rmse) if interval else None,
    )


def _root(square: float) -> float:
    return float(np.sqrt(max(0.0, square)))
