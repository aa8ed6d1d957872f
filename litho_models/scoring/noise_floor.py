"""Estimate the noise floor of a dataset: the smallest possible error of any model, for each set of per-scan
terms.

The floor is measured on flat or repeated prints if there are any. Otherwise it is estimated from the
out-of-fold residuals of a model, by comparing pixels with similar surroundings (``like_layouts``).
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
    """The floor of the errors (in nm) under one nuisance policy, with 95 % confidence intervals over prints.

    ``k`` is the number of terms per scan. If the policy includes line offsets, it is the effective number of
    terms. The intervals are None if there are fewer than six prints.
    """

    policy: Policy
    k: float
    mae_nm: float
    mae_ci95_nm: Interval
    rmse_nm: float
    rmse_ci95_nm: Interval


class NoiseFloor(Record):
    """The error that noise alone causes; ``kind`` states how it was estimated.

    ``mae_nm`` and ``rmse_nm`` are the floors under policy ``offset``. ``by_policy`` has a floor for each
    policy; it is empty in older result files, or if only the floor of ``offset`` is known. The kinds
    ``lower-bound`` and ``literature`` occur in older files; ``lower-bound`` also occurs in loops on fewer
    than three scans.
    """

    mae_nm: float | None
    rmse_nm: float | None
    kind: Literal["measured", "upper-estimate", "lower-bound", "literature", "unknown"]
    source: str
    by_policy: list[PolicyFloor] = Field(default_factory=list)

    def at(self, policy: str) -> PolicyFloor | None:
        """Return the floor of the errors under this policy; None if it is unknown."""
        return next((row for row in self.by_policy if row.policy == policy), None)

    def mae_at(self, policy: str) -> float | None:
        """Return the floor of the mean absolute error under this policy, in nm; None if it is unknown."""
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
    """The parts of a noise analysis that this module reads: its dataset and the floor."""

    SCHEMA = "litho-models/noise/1"
    FILE_NAME = NOISE_FILE

    dataset: DatasetId | None
    noise_floor: NoiseFloor


def stated_floor(dataset_name: str, analysis: str | Path | None) -> NoiseFloor:
    """Read the floor from a noise analysis; without an analysis, the floor is unknown.

    Args:
        dataset_name: name of the dataset for which errors are reported.
        analysis: path of ``noise.json`` or of its folder. The analysis must describe this dataset, or scans
            without a dataset.

    Raises:
        InputError: no noise analysis at this path, or an analysis of another dataset.
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
    """Estimate an upper limit on the floor under every policy, from predictions of held-out scans.

    Args:
        model: its name, for ``source``.
        scans: held-out scans.
        maps_um: for each scan, the map that the model expects, (ny, nx) in µm.
        blocks: selects the pixels to which terms are fitted and the pixels that are scored. Use the same
            blocks as for the errors that are compared with the floor.
        seed: decides which pixels are drawn.
    """
    return floor_of_residuals(model, scans, freed_by_policy(scans, maps_um, blocks), seed)


def freed_by_policy(
    scans: Sequence[PrintedScan],
    maps_um: Sequence[np.ndarray],
    blocks: Blocks | None = None,
    policies: Iterable[Policy] = tuple(POLICIES),
) -> dict[Policy, list[CrossFit]]:
    """Return the residuals of each scan under each policy. ``maps_um`` contains the expected maps, (ny, nx)
    in µm.
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
    """Estimate an upper limit on the floor from the residuals of held-out scans.

    On a random sample of pixels, ``LikePixels`` finds the fraction of the squared error that pixels with
    similar surroundings do not share. The floor is the error over all scored pixels times the square root of
    this fraction. For the mean absolute error, this assumes that the distributions of the noise and of the
    residual have the same shape, that is, the same E|n|/σ. The noise need not be Gaussian, because nearly all
    of the residual is noise. Suppose that half of the squared error came from a misfit with another
    distribution than the noise (a Laplace distribution in Gaussian noise, or the reverse). Then the floor
    would be wrong by up to 6 %.

    Args:
        model: its name, for ``source``.
        scans: held-out scans.
        freed: result of ``freed_by_policy``, which must include the policy ``offset``.
        seed: decides which pixels are drawn.
    """
    # Scans are taken in the order of their ids, so that the same scans always give the same pixels.
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
