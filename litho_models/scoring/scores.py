"""One routine that scores every model: predictions of scans in, one validated record out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.scan_terms.background import BackgroundUse
from litho_models.scan_terms.nuisance import (
    POLICIES,
    TERM_COUNT,
    Policy,
    cross_fitted_residual,
    scan_line_index,
)
from litho_models.scoring.edges import edge_placement, mid_step_heights_um
from litho_models.scoring.metrics import ScanScore, phase_waves, score_scan
from litho_models.scoring.records import (
    Interval,
    ModelScores,
    NuisanceProtocol,
    PolicyError,
    Prediction,
    ScanRow,
    ShapeFigures,
)
from litho_models.scoring.similarity import structural_similarity
from litho_models.scoring.statistics import bootstrap_interval
from litho_models.scoring.transfer import level_errors, transfer_curves

# Policies without smooth terms of their own: only their errors know of a smooth background.
_BLIND_POLICIES: tuple[Policy, ...] = ("none", "offset", "offset-gain")


class NoiseFloor(Record):
    """The error that roughness and microscope alone would leave; ``kind`` says how it is known."""

    mae_nm: float | None
    rmse_nm: float | None
    kind: str
    source: str


def score_model(
    name: str,
    scans: Sequence[PrintedScan],
    predictions: Sequence[Prediction],
    protocol: NuisanceProtocol,
) -> ModelScores:
    """Score the predictions of one model on whole scans under one protocol and, beside it, all policies.

    ``row_offset_sd_nm`` and ``scan_line_offset_sd_nm`` say in which frame line offsets live: along the
    layout's rows (the print) or along the scan's own lines (the microscope).

    Args:
        name: name of the model.
        scans: the scans; ``predictions``: what the model expects of each.
        protocol: what scans are freed of, and whether the predictions have backgrounds.

    Raises:
        InputError: predictions that are not finite, or a scan too small for the policies.
    """
    geometry: dict[str, Any] = protocol.model_dump(include={"block_px", "buffer_px", "seed"})
    maps = [prediction.map_um for prediction in predictions]
    heights = [prediction.height_um for prediction in predictions]
    scores = {policy: _scan_scores(scans, maps, policy, geometry) for policy in POLICIES}
    chosen = scores[protocol.policy]
    bare = _BLIND_POLICIES if protocol.background == "training" else ()
    residuals, rows, lines = [], [], []
    for scan, expected in zip(scans, maps, strict=True):
        arrays = (scan.height_um, expected, scan.valid)
        residuals.append(cross_fitted_residual(*arrays, protocol.policy, **geometry).residual_um)
        line = scan_line_index(scan.shape, scan.scan_to_layout, scan.pitch_um, scan.bend_um)
        rows.append(cross_fitted_residual(*arrays, "full+rows", **geometry).row_sd_um)
        lines.append(cross_fitted_residual(*arrays, "full+rows", scan_line=line, **geometry).row_sd_um)
    shapes = [
        _shape(scan, expected, residual)
        for scan, expected, residual in zip(scans, maps, residuals, strict=True)
    ]
    return ModelScores(
        model=name,
        scans=[_row(scan, score, shape) for scan, score, shape in zip(scans, chosen, shapes, strict=True)],
        mae_abs_nm=_mean(chosen, "mae_abs_nm"),
        mae_abs_ci95_nm=interval([score.mae_abs_nm for score in chosen]),
        bias_nm=_mean(chosen, "bias_nm"),
        mae_datum_free_nm=_mean(chosen, "mae_datum_free_nm"),
        mae_datum_free_ci95_nm=interval([score.mae_datum_free_nm for score in chosen]),
        rmse_datum_free_nm=_mean(chosen, "rmse_datum_free_nm"),
        rmse_datum_free_ci95_nm=interval([score.rmse_datum_free_nm for score in chosen]),
        by_policy=[_policy_error(policy, scores[policy]) for policy in POLICIES],
        without_background=[
            _policy_error(policy, _scan_scores(scans, heights, policy, geometry)) for policy in bare
        ],
        phase_rms_waves=phase_waves(_mean(chosen, "rmse_datum_free_nm") / NM_PER_UM),
        **_over_scans(shapes),
        by_level=level_errors(scans, residuals),
        transfer=transfer_curves(scans, maps),
        row_offset_sd_nm=NM_PER_UM * float(np.sqrt(np.mean(np.square(rows)))),
        scan_line_offset_sd_nm=NM_PER_UM * float(np.sqrt(np.mean(np.square(lines)))),
        dropped_pixels=sum(int(np.sum(~np.isfinite(r))) for r in residuals),
        constant_predictions=sum(bool(np.ptp(height) == 0) for height in heights),
    )


def _scan_scores(
    scans: Sequence[PrintedScan], maps_um: Sequence[np.ndarray], policy: Policy, geometry: dict[str, Any]
) -> list[ScanScore]:
    return [
        score_scan(scan.id, scan.height_um, prediction, scan.valid, policy, **geometry)
        for scan, prediction in zip(scans, maps_um, strict=True)
    ]


def _policy_error(policy: Policy, scores: Sequence[ScanScore]) -> PolicyError:
    values = [score.mae_datum_free_nm for score in scores]
    freedom = float(np.mean([score.degrees_of_freedom for score in scores]))
    return PolicyError(policy=policy, k=freedom, mae_nm=float(np.mean(values)), ci95_nm=interval(values))


def protocol_for(policy: Policy, seed: int = 0, background: BackgroundUse = "none") -> NuisanceProtocol:
    """The standard protocol of a policy."""
    return NuisanceProtocol(policy=policy, k=float(TERM_COUNT[policy]), seed=seed, background=background)


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


def _row(scan: PrintedScan, score: ScanScore, shape: ShapeFigures) -> ScanRow:
    kept: dict[str, Any] = {
        key: None if value != value else value  # NaN: cannot be known
        for key, value in asdict(score).items()
        if key in ScanRow.model_fields
    }
    return ScanRow(scan=scan.id, print=scan.print_id, **kept, **shape.model_dump())


def _shape(scan: PrintedScan, expected_um: np.ndarray, residual_um: np.ndarray) -> ShapeFigures:
    freed = expected_um + residual_um
    heights = mid_step_heights_um(scan.levels, scan.level_height_um)
    edges = edge_placement(freed, expected_um, heights, scan.pitch_um)
    named = {f"edge_{key}": value for key, value in edges._asdict().items()}
    return ShapeFigures(ssim=structural_similarity(freed, expected_um), **named)


def _over_scans(shapes: Sequence[ShapeFigures]) -> dict[str, Any]:
    """Means of what is known, sums of counts."""
    figures: dict[str, Any] = {}
    for name in ("ssim", "edge_mean_nm", "edge_p95_nm"):
        known = [value for value in (getattr(shape, name) for shape in shapes) if value is not None]
        figures[name] = float(np.mean(known)) if known else None
    for name in ("edge_matched", "edge_unmatched", "edge_unmatched_expected"):
        figures[name] = sum(getattr(shape, name) for shape in shapes)
    return figures


def _mean(scores: Sequence[ScanScore], field: str) -> float:
    return float(np.mean([getattr(score, field) for score in scores]))
