"""Tables that the evaluation and benchmark reports share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from litho_models.scores import Interval, ModelScores, NuisanceProtocol

if TYPE_CHECKING:
    import pandas as pd


def headline_table(scores: Sequence[ModelScores]) -> pd.DataFrame:
    """One row per model: both error figures with intervals, spread and bias."""
    import pandas as pd

    return pd.DataFrame(
        [
            {
                "model": s.model,
                "mae_datum_free_nm": s.mae_datum_free_nm,
                "mae_datum_free_ci95_nm": interval_text(s.mae_datum_free_ci95_nm),
                "rmse_datum_free_nm": s.rmse_datum_free_nm,
                "mae_abs_nm": s.mae_abs_nm,
                "mae_abs_ci95_nm": interval_text(s.mae_abs_ci95_nm),
                "bias_nm": s.bias_nm,
                "scans": len(s.scans),
            }
            for s in scores
        ]
    )


def policy_table(scores: Sequence[ModelScores]) -> pd.DataFrame:
    """One row per model, one column per nuisance policy."""
    import pandas as pd

    return pd.DataFrame(
        [{"model": s.model, **{f"{e.policy}_mae_nm": e.mae_nm for e in s.by_policy}} for s in scores]
    )


def scan_table(scores: Sequence[ModelScores]) -> pd.DataFrame:
    """One row per model and scan."""
    import pandas as pd

    return pd.DataFrame([{"model": s.model, **row.model_dump()} for s in scores for row in s.scans])


def level_table(scores: Sequence[ModelScores]) -> pd.DataFrame:
    """One row per model and printed level."""
    import pandas as pd

    return pd.DataFrame([{"model": s.model, **entry.model_dump()} for s in scores for entry in s.by_level])


def interval_text(interval: Interval) -> str:
    """An interval for people."""
    return "–" if interval is None else f"{interval[0]:.2f} … {interval[1]:.2f}"


def protocol_text(protocol: NuisanceProtocol) -> str:
    """How the datum-free figure was obtained, in one paragraph."""
    return (
        f"mae_abs has no fit at test time. mae_datum_free frees each scan of the nuisances of policy "
        f"'{protocol.policy}' (k = {protocol.k:g} per scan), fitted on one half of a checkerboard of "
        f"{protocol.block_px} px blocks shrunk by {protocol.buffer_px} px and scored on the other half, "
        "both halves swapped; 'full+rows' uses stripes of columns instead. Means are per scan first, then "
        "over scans; intervals resample whole scans (2,000 draws)."
    )


def caveats(scores: Sequence[ModelScores]) -> list[str]:
    """Things worth knowing about the numbers: what was dropped, what is degenerate, what is small."""
    notes = []
    for s in scores:
        if s.constant_predictions:
            notes.append(f"{s.model} predicts a constant height for {s.constant_predictions} scans.")
        if s.dropped_pixels:
            notes.append(
                f"{s.model}: {s.dropped_pixels} pixels were not measured or not valid and are not scored."
            )
    if scores and len(scores[0].scans) < 8:
        notes.append(f"Only {len(scores[0].scans)} scans: intervals over scans are rough.")
    if scores:
        s = min(scores, key=lambda entry: entry.mae_datum_free_nm)
        notes.append(
            f"Line offsets left by {s.model}: {s.row_offset_sd_nm:.1f} nm along the rows of the layout, "
            f"{s.scan_line_offset_sd_nm:.1f} nm along the scan's own lines. Offsets that follow the layout "
            "although the scans are rotated belong to the print, not to the microscope."
        )
    return notes
