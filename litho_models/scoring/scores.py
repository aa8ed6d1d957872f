"""One routine that scores every model: predictions of scans in, one validated record out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.scan_terms import POLICIES, Blocks, NuisanceProtocol, Policy, cross_fit, scan_line_index
from litho_models.scoring.metric_registry import metrics_of, metrics_over_scans
from litho_models.scoring.metrics import ScanScore, phase_waves, score_scan
from litho_models.scoring.records import ModelScores, PolicyError, Prediction, ScanRow
from litho_models.scoring.statistics import interval
from litho_models.scoring.transfer import level_errors, transfer_curves

# Policies without smooth terms of their own: only their errors know of a smooth background.
_BLIND_POLICIES: tuple[Policy, ...] = ("none", "offset", "offset-gain")


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
    blocks = protocol.blocks
    maps = [prediction.map_um for prediction in predictions]
    heights = [prediction.height_um for prediction in predictions]
    scores = {policy: _scan_scores(scans, maps, policy, blocks) for policy in POLICIES}
    chosen = scores[protocol.policy]
    bare = _BLIND_POLICIES if protocol.background != "none" else ()
    residuals, lines = [], []
    for scan, expected in zip(scans, maps, strict=True):
        arrays = (scan.height_um, expected, scan.valid)
        residuals.append(cross_fit(*arrays, POLICIES[protocol.policy], blocks).residual_um)
        line = scan_line_index(scan.shape, scan.scan_to_layout, scan.pitch_um, scan.bend_um)
        along_lines = POLICIES["full"] | {"scan-lines"}
        lines.append(cross_fit(*arrays, along_lines, blocks, scan_line=line).line_sd_um)
    rows = [score.line_sd_um for score in scores["full+rows"]]
    table = [
        _row(scan, score, metrics_of(scan, expected, residual))
        for scan, score, expected, residual in zip(scans, chosen, maps, residuals, strict=True)
    ]
    return ModelScores(
        model=name,
        scans=table,
        seen_by=scans[0].seen_by,
        edge_mean_ci95_nm=interval([row.edge_mean_nm for row in table if row.edge_mean_nm is not None]),
        mae_abs_nm=_mean(chosen, "mae_abs_nm"),
        mae_abs_ci95_nm=interval([score.mae_abs_nm for score in chosen]),
        bias_nm=_mean(chosen, "bias_nm"),
        mae_datum_free_nm=_mean(chosen, "mae_datum_free_nm"),
        mae_datum_free_ci95_nm=interval([score.mae_datum_free_nm for score in chosen]),
        rmse_datum_free_nm=_mean(chosen, "rmse_datum_free_nm"),
        rmse_datum_free_ci95_nm=interval([score.rmse_datum_free_nm for score in chosen]),
        by_policy=[_policy_error(policy, scores[policy]) for policy in POLICIES],
        without_background=[
            _policy_error(policy, _scan_scores(scans, heights, policy, blocks)) for policy in bare
        ],
        phase_rms_waves=phase_waves(_mean(chosen, "rmse_datum_free_nm") / NM_PER_UM),
        **metrics_over_scans(table),
        by_level=level_errors(scans, residuals),
        transfer=transfer_curves(scans, maps),
        row_offset_sd_nm=NM_PER_UM * float(np.sqrt(np.mean(np.square(rows)))),
        scan_line_offset_sd_nm=NM_PER_UM * float(np.sqrt(np.mean(np.square(lines)))),
        dropped_pixels=sum(int(np.sum(~np.isfinite(r))) for r in residuals),
        constant_predictions=sum(bool(np.ptp(height) == 0) for height in heights),
    )


def _scan_scores(
    scans: Sequence[PrintedScan], maps_um: Sequence[np.ndarray], policy: Policy, blocks: Blocks
) -> list[ScanScore]:
    return [
        score_scan(scan.id, scan.height_um, prediction, scan.valid, policy, blocks)
        for scan, prediction in zip(scans, maps_um, strict=True)
    ]


def _policy_error(policy: Policy, scores: Sequence[ScanScore]) -> PolicyError:
    values = [score.mae_datum_free_nm for score in scores]
    freedom = float(np.mean([score.degrees_of_freedom for score in scores]))
    return PolicyError(policy=policy, k=freedom, mae_nm=float(np.mean(values)), ci95_nm=interval(values))


def _row(scan: PrintedScan, score: ScanScore, metrics: dict[str, Any]) -> ScanRow:
    kept: dict[str, Any] = {
        key: None if value != value else value  # NaN: cannot be known
        for key, value in asdict(score).items()
        if key in ScanRow.model_fields
    }
    return ScanRow(scan=scan.id, print=scan.print_id, **kept, **metrics)


def _mean(scores: Sequence[ScanScore], field: str) -> float:
    return float(np.mean([getattr(score, field) for score in scores]))
