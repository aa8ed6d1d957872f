"""Score a model: compute all errors and metrics from its predictions of scans."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.scan_terms import POLICIES, BackgroundUse, CrossFit, NuisanceProtocol, Policy
from litho_models.scoring.metric_registry import metrics_of, metrics_over_scans
from litho_models.scoring.metrics import phase_waves, scan_errors
from litho_models.scoring.noise_floor import freed_by_policy
from litho_models.scoring.records import ModelScores, PolicyError, Prediction, ScanRow
from litho_models.scoring.statistics import interval
from litho_models.scoring.transfer import level_errors, transfer_curves

# For each kind of background, the policies with which the errors depend on this background. Smooth terms such
# as tilt would absorb a smooth background, but not the displacements of the shared measurement model.
_DEPENDENT_POLICIES: Mapping[BackgroundUse, tuple[Policy, ...]] = {
    "none": (),
    "training": ("none", "offset", "offset-gain"),
    "shared": tuple(POLICIES),
}


def score_model(
    name: str,
    scans: Sequence[PrintedScan],
    predictions: Sequence[Prediction],
    protocol: NuisanceProtocol,
) -> ModelScores:
    """Score the predictions of one model. The main scores are computed with the terms of the given protocol.
    The mean absolute error is also computed for every other policy (set of per-scan terms).

    Args:
        name: name of the model.
        scans: the scans.
        predictions: predictions of the model, one for each scan.
        protocol: states which terms are fitted to each scan, and whether the predictions include a
            background.

    Raises:
        InputError: a prediction is not finite, or a scan is too small for the policies.
    """
    blocks = protocol.blocks
    maps = [prediction.map_um for prediction in predictions]
    heights = [prediction.height_um for prediction in predictions]
    freed = freed_by_policy(scans, maps, blocks)
    bare = _DEPENDENT_POLICIES[protocol.background]
    chosen, rows = freed[protocol.policy], []
    for scan, expected, fit in zip(scans, maps, chosen, strict=True):
        errors = scan_errors(scan.id, scan.height_um, expected, fit).model_dump()
        metrics = metrics_of(scan, expected, fit.residual_um)
        rows.append(ScanRow(scan=scan.id, print=scan.print_id, **errors, **metrics))
    residuals = [fit.residual_um for fit in chosen]
    over_scans: dict[str, Any] = {"bias_nm": float(np.mean([row.bias_nm for row in rows]))}
    for figure in ("mae_abs", "mae_datum_free", "rmse_datum_free"):
        values = [getattr(row, f"{figure}_nm") for row in rows]
        over_scans |= {f"{figure}_nm": float(np.mean(values)), f"{figure}_ci95_nm": interval(values)}
    return ModelScores(
        model=name,
        scans=rows,
        seen_by=scans[0].seen_by,
        edge_mean_ci95_nm=interval([row.edge_mean_nm for row in rows if row.edge_mean_nm is not None]),
        **over_scans,
        by_policy=_policy_errors(freed),
        without_background=_policy_errors(freed_by_policy(scans, heights, blocks, bare)),
        phase_rms_waves=phase_waves(over_scans["rmse_datum_free_nm"] / NM_PER_UM),
        **metrics_over_scans(rows),
        by_level=level_errors(scans, residuals),
        transfer=transfer_curves(scans, maps),
        dropped_pixels=sum(int(np.sum(~np.isfinite(r))) for r in residuals),
        constant_predictions=sum(bool(np.ptp(height) == 0) for height in heights),
    )


def _policy_errors(freed: Mapping[Policy, Sequence[CrossFit]]) -> list[PolicyError]:
    found = []
    for policy, fits in freed.items():
        values = [NM_PER_UM * float(np.nanmean(np.abs(fit.residual_um))) for fit in fits]
        k = float(np.mean([fit.degrees_of_freedom for fit in fits]))
        found.append(PolicyError(policy=policy, k=k, mae_nm=float(np.mean(values)), ci95_nm=interval(values)))
    return found
