"""``report.html`` of one evaluated model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation.report import Page
from litho_data.store import PrintedScan
from litho_models.evaluation import plots as figures
from litho_models.evaluation import tables as score_tables

if TYPE_CHECKING:
    import pandas as pd

    from litho_models.evaluation.evaluate import Evaluation, ModelRecord, SplitRecord


def write_evaluation_report(
    result: Evaluation, scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray], out: str | Path
) -> Path:
    """Render the result into ``out``; returns the page."""
    scores = result.scores
    page = Page(
        f"{result.model.name} on {result.dataset.name}",
        f"{len(scores.scans)} scans, datum-free MAE {scores.mae_datum_free_nm:.2f} nm.",
    )
    page.tiles(
        [
            (f"{scores.mae_datum_free_nm:.2f} nm", "MAE, datum-free"),
            (f"{scores.mae_abs_nm:.2f} nm", "MAE, no fit at test time"),
            (f"{scores.bias_nm:.1f} nm", "bias"),
        ]
    )
    if result.trained_on_scored_scans:
        count = len(result.trained_on_scored_scans)
        page.note(f"{count} of the scored scans were used in training: this is not a held-out error.")
    page.note(lock_box_text(result.split))
    if result.model.extrapolated:
        page.note("Layouts beyond the calibrated range were accepted (extrapolate).")
    page.paragraph(score_tables.protocol_text(result.nuisance))
    page.figure(figures.error_bars([scores], result.noise_floor, False), "Error and noise floor.")
    page.table(score_tables.headline_table([scores], result.noise_floor), "Error over scans.", "headline.csv")
    page.paragraph(score_tables.floor_text(result.noise_floor))
    page.table(
        score_tables.policy_table([scores], result.nuisance),
        "MAE under every nuisance policy, with and without the background, nm.",
        "policies.csv",
    )
    page.table(score_tables.metric_table([scores]), "Phase, similarity, edges.", "shapes.csv", digits=3)
    page.paragraph(score_tables.metric_text())
    page.table(
        _model(result.model),
        "The same pixels in another crop; what predicting a scan costs on the machine that made this.",
        "model.csv",
    )
    worst = max(range(len(scans)), key=lambda i: scores.scans[i].mae_datum_free_nm)
    shown = {scores.model: predictions_um[worst]}
    page.heading("The worst scan")
    page.figure(figures.residual_maps(scans[worst], shown, result.nuisance), "Measured height and error.")
    page.figure(figures.line_profiles(scans[worst], shown, result.nuisance), "Middle row.")
    page.heading("By level and frequency")
    page.figure(figures.level_bias([scores]), "Error by printed level.")
    page.figure(figures.transfer([scores]), "Transfer, coherence and error by spatial frequency.")
    page.table(
        score_tables.band_table([scores]),
        "How far up in frequency the prediction follows the measurement, cycles/µm.",
        "bands.csv",
    )
    page.paragraph(score_tables.band_text())
    page.heading("Tables")
    page.table(score_tables.scan_table([scores]), "By scan.", "scans.csv")
    page.table(score_tables.level_table([scores]), "By level.", "levels.csv")
    page.heading("Things worth knowing about these numbers")
    for note in score_tables.caveats([scores]):
        page.paragraph(note)
    page.code(result.run.command)
    return page.write(out)


def lock_box_text(split: SplitRecord) -> str:
    """What was done with the locked scans of the dataset."""
    if not split.lock_box:
        return "The dataset is too small for locked scans."
    scored = [scan_id for scan_id in split.lock_box if scan_id in split.scored_ids]
    if not scored:
        return f"The {len(split.lock_box)} locked scans of the dataset were left out."
    return f"Locked scans of the dataset are among the scored ones: {', '.join(scored)}."


def _model(model: ModelRecord) -> pd.DataFrame:
    import pandas as pd

    assert model.cost is not None, "an evaluation measures its predictions"
    columns = score_tables.prediction_columns(model.tiles, model.cost)
    return pd.DataFrame([{"model": model.name, "parameters": model.parameters, **columns}])
