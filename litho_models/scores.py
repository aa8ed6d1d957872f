"""One routine that scores every model: predictions of scans in, one validated record out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.errors import InputError
from litho_data.results import Record
from litho_data.store import PrintedScan
from litho_models.curves import LevelError, TransferCurves, level_errors, transfer_curves
from litho_models.metrics import ScanScore, bootstrap_interval, score_scan
from litho_models.nuisance import (
    BLOCK_PX,
    BUFFER_PX,
    POLICIES,
    TERM_COUNT,
    Policy,
    cross_fitted_residual,
    scan_line_index,
)

Interval = tuple[float, float] | None


class NuisanceProtocol(Record):
    """What a scan may be freed of before it is scored, and on which pixels that was fitted."""

    policy: Policy = "offset"
    k: float = 1.0
    block_px: int = BLOCK_PX
    buffer_px: int = BUFFER_PX
    seed: int = 0


class NoiseFloor(Record):
    """The error that roughness and microscope alone would leave; ``kind`` says how it is known."""

    mae_nm: float | None
    rmse_nm: float | None
    kind: str
    source: str


class PolicyError(Record):
    """Mean absolute error under one nuisance policy, nm, with its interval over scans."""

    policy: Policy
    k: float
    mae_nm: float
    ci95_nm: Interval


class ScanRow(Record):
    """The figures of one scan."""

    scan: str
    print: str
    mae_abs_nm: float
    bias_nm: float
    mae_datum_free_nm: float
    rmse_datum_free_nm: float
    median_abs_datum_free_nm: float
    p95_abs_datum_free_nm: float
    slope: float
    intercept_nm: float
    pixels: int


class ModelScores(Record):
    """Everything reported about one model; means are over scans, intervals resample scans."""

    model: str
    scans: list[ScanRow]
    mae_abs_nm: float
    mae_abs_ci95_nm: Interval
    bias_nm: float
    mae_datum_free_nm: float
    mae_datum_free_ci95_nm: Interval
    rmse_datum_free_nm: float
    rmse_datum_free_ci95_nm: Interval
    by_policy: list[PolicyError]
    by_level: list[LevelError]
    transfer: TransferCurves
    row_offset_sd_nm: float
    scan_line_offset_sd_nm: float
    dropped_pixels: int
    constant_predictions: int


def score_model(
    name: str,
    scans: Sequence[PrintedScan],
    predictions_um: Sequence[np.ndarray],
    protocol: NuisanceProtocol,
) -> ModelScores:
    """Score the predictions of one model on whole scans under one protocol and, beside it, all policies.

    ``row_offset_sd_nm`` and ``scan_line_offset_sd_nm`` say in which frame line offsets live: along the
    layout's rows (the print) or along the scan's own lines (the microscope).

    Raises:
        InputError: predictions that are not finite, or a scan too small for the policies.
    """
    geometry: dict[str, Any] = protocol.model_dump(include={"block_px", "buffer_px", "seed"})
    by_policy: list[PolicyError] = []
    chosen: list[ScanScore] = []
    for policy in POLICIES:
        scores = [
            score_scan(scan.id, scan.height_um, prediction, scan.valid, policy, **geometry)
            for scan, prediction in zip(scans, predictions_um, strict=True)
        ]
        values = [score.mae_datum_free_nm for score in scores]
        freedom = float(np.mean([score.degrees_of_freedom for score in scores]))
        by_policy.append(
            PolicyError(policy=policy, k=freedom, mae_nm=float(np.mean(values)), ci95_nm=interval(values))
        )
        chosen = scores if policy == protocol.policy else chosen
    residuals, rows, lines = [], [], []
    for scan, prediction in zip(scans, predictions_um, strict=True):
        arrays = (scan.height_um, prediction, scan.valid)
        residuals.append(cross_fitted_residual(*arrays, protocol.policy, **geometry).residual_um)
        line = scan_line_index(scan.shape, scan.scan_to_layout, scan.pitch_um)
        rows.append(cross_fitted_residual(*arrays, "full+rows", **geometry).row_sd_um)
        lines.append(cross_fitted_residual(*arrays, "full+rows", scan_line=line, **geometry).row_sd_um)
    return ModelScores(
        model=name,
        scans=[_row(scan, score) for scan, score in zip(scans, chosen, strict=True)],
        mae_abs_nm=_mean(chosen, "mae_abs_nm"),
        mae_abs_ci95_nm=interval([score.mae_abs_nm for score in chosen]),
        bias_nm=_mean(chosen, "bias_nm"),
        mae_datum_free_nm=_mean(chosen, "mae_datum_free_nm"),
        mae_datum_free_ci95_nm=interval([score.mae_datum_free_nm for score in chosen]),
        rmse_datum_free_nm=_mean(chosen, "rmse_datum_free_nm"),
        rmse_datum_free_ci95_nm=interval([score.rmse_datum_free_nm for score in chosen]),
        by_policy=by_policy,
        by_level=level_errors(scans, residuals),
        transfer=transfer_curves(scans, predictions_um),
        row_offset_sd_nm=1000 * float(np.sqrt(np.mean(np.square(rows)))),
        scan_line_offset_sd_nm=1000 * float(np.sqrt(np.mean(np.square(lines)))),
        dropped_pixels=sum(int(np.sum(~np.isfinite(r))) for r in residuals),
        constant_predictions=sum(bool(np.ptp(prediction) == 0) for prediction in predictions_um),
    )


def protocol_for(policy: Policy, seed: int = 0) -> NuisanceProtocol:
    """The standard protocol of a policy: k is the number of its smooth terms."""
    return NuisanceProtocol(policy=policy, k=float(TERM_COUNT[policy]), seed=seed)


def interval(values: Sequence[float]) -> Interval:
    """Bootstrap interval over scans, or None with fewer than two."""
    return bootstrap_interval(values) if len(values) > 1 else None


def noise_floor(dataset_name: str, analysis: str | Path | None = None) -> NoiseFloor:
    """What is known about the floor of a dataset: from its noise analysis, else from the literature.

    Args:
        dataset_name: name of the dataset whose errors are reported.
        analysis: ``noise.json``, or its folder, of this dataset or of scans without one.

    Raises:
        InputError: no noise analysis there, or one of another dataset.
    """
    if analysis is not None:
        from litho_models.noise.result import NoiseAnalysis

        found = NoiseAnalysis.read(analysis)
        if found.dataset is not None and found.dataset.name != dataset_name:
            raise InputError(f"noise analysis {analysis}", got=found.dataset.name, wanted=dataset_name)
        return found.noise_floor
    if dataset_name == "neural-lithography":
        # 0.798 σ is the mean absolute value of a Gaussian of standard deviation σ.
        return NoiseFloor(
            mae_nm=12.7,
            rmse_nm=15.96,
            kind="literature",
            source="roughness of the paper's flat print (arXiv:2309.17343); MAE 0.798 σ if Gaussian; "
            "its band and levelling are not those of these scans",
        )
    return NoiseFloor(
        mae_nm=None, rmse_nm=None, kind="unknown", source="no flat or repeated print in the store"
    )


def _row(scan: PrintedScan, score: ScanScore) -> ScanRow:
    kept = {key: value for key, value in asdict(score).items() if key in ScanRow.model_fields}
    return ScanRow(scan=scan.id, print=scan.print_id, **kept)


def _mean(scores: Sequence[ScanScore], field: str) -> float:
    return float(np.mean([getattr(score, field) for score in scores]))
