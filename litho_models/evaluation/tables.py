"""Make the tables for the reports of evaluations and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.metric_registry import metrics_text, registered_metrics
from litho_models.scoring.metrics import INDEX_STEP, WAVELENGTH_UM
from litho_models.scoring.noise_floor import NoiseFloor
from litho_models.scoring.records import ModelScores
from litho_models.scoring.statistics import Interval

if TYPE_CHECKING:
    import pandas as pd


# Each row is a mapping from column to value.
Rows = list[dict[str, Any]]


def headline_table(
    scores: Sequence[ModelScores], protocol: NuisanceProtocol, floor: NoiseFloor
) -> pd.DataFrame:
    """Return the main table of a report. Each row states the two errors of one model with their confidence
    intervals, the excess over the noise floor, the RMS error and the bias.

    The last row is the noise floor. Each value of the floor is computed with the same per-scan terms as the
    errors in its column. For films, the table lists the errors of edges and features instead of height
    errors, and it has no noise floor.
    """
    import pandas as pd

    if scores[0].seen_by == "sem":
        return pd.DataFrame([_film_row(score) for score in scores])
    below = floor.at(protocol.policy)
    least = floor.mae_at(protocol.policy)
    rows = [
        {
            "model": s.model,
            "mae_datum_free_nm": s.mae_datum_free_nm,
            "mae_datum_free_ci95_nm": interval_text(s.mae_datum_free_ci95_nm),
            "above_floor_nm": None if least is None else s.mae_datum_free_nm - least,
            "rmse_datum_free_nm": s.rmse_datum_free_nm,
            "mae_abs_nm": s.mae_abs_nm,
            "mae_abs_ci95_nm": interval_text(s.mae_abs_ci95_nm),
            "bias_nm": s.bias_nm,
            "scans": len(s.scans),
        }
        for s in scores
    ]
    known = {
        "model": f"noise floor ({floor.kind.replace('-', ' ')})",
        "mae_datum_free_nm": least,
        "mae_datum_free_ci95_nm": interval_text(below.mae_ci95_nm if below else None),
        "rmse_datum_free_nm": below.rmse_nm if below else floor.rmse_nm if least is not None else None,
        "mae_abs_nm": floor.mae_at("none"),
        "scans": "",
    }
    return pd.DataFrame([*rows, known])


def _film_row(score: ModelScores) -> dict[str, Any]:
    return {
        "model": score.model,
        "edge_mean_nm": score.edge_mean_nm,
        "edge_mean_ci95_nm": interval_text(score.edge_mean_ci95_nm),
        "edge_p95_nm": score.edge_p95_nm,
        **score.metrics,
        "edge_unmatched": score.edge_unmatched,
        "edge_unmatched_expected": score.edge_unmatched_expected,
        "mae_abs_nm": score.mae_abs_nm,
        "scans": len(score.scans),
    }


def policy_table(scores: Sequence[ModelScores], protocol: NuisanceProtocol, floor: NoiseFloor) -> Rows:
    """Return a table of mean absolute errors. There is one column for each policy (set of per-scan terms).
    Each model has one row. If the protocol states a background, this row contains the errors with the
    background, and a second row contains the errors without it. For the policy with line offsets
    (``full+rows``), a second column states the effective number of terms per scan.

    The last row is the noise floor for each policy.
    """
    rows = []
    for s in scores:
        for background, errors in ((protocol.background, s.by_policy), ("none", s.without_background)):
            if errors:
                named = {f"{error.policy}_mae_nm": error.mae_nm for error in errors}
                lines = {f"{error.policy}_k": error.k for error in errors if error.policy == "full+rows"}
                rows.append({"model": s.model, "background": background, **named, **lines})
    if floor.by_policy:
        below = {f"{row.policy}_mae_nm": row.mae_nm for row in floor.by_policy}
        rows.append(
            {
                "model": f"noise floor ({floor.kind.replace('-', ' ')})",
                "background": protocol.background,
                **below,
            }
        )
    return rows


def metric_table(scores: Sequence[ModelScores]) -> Rows:
    """Return one row per model, with the phase error and all metrics of ``metric_registry`` that were
    computed.
    """
    keys = _measured(scores)
    return [
        {
            "model": s.model,
            "phase_rms_waves": s.phase_rms_waves,
            **{key: s.metric(key) for key in keys},
        }
        for s in scores
    ]


def _measured(scores: Sequence[ModelScores]) -> list[str]:
    return [m.key for m in registered_metrics() if any(s.metric(m.key) is not None for s in scores)]


def scan_table(scores: Sequence[ModelScores]) -> Rows:
    """Return one row per model and scan."""
    return [
        {
            "model": s.model,
            "scan": row.scan,
            "print": row.print,
            **row.model_dump(exclude={"metrics", "scan", "print"}),
            **row.metrics,
        }
        for s in scores
        for row in s.scans
    ]


def level_table(scores: Sequence[ModelScores]) -> Rows:
    """Return one row per model and printed level."""
    return [{"model": s.model, **entry.model_dump()} for s in scores for entry in s.by_level]


def interval_text(interval: Interval) -> str:
    """Format an interval as text. If there is no interval, return a dash."""
    return "–" if interval is None else f"{interval[0]:.2f} … {interval[1]:.2f}"


def metric_text(scores: Sequence[ModelScores]) -> str:
    """Return sentences that explain the columns of ``metric_table``."""
    return (
        f"The phase error is the RMS error seen by light of {WAVELENGTH_UM:g} µm that passes through the "
        f"print (index step {INDEX_STEP:g}). {metrics_text(_measured(scores))}"
    )
