"""Tables of scores, levels and distances that several reports use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from litho_data.foundation.results import Record
from litho_design.tasks.design import Design


def meanings(score: type[Record]) -> dict[str, str]:
    """Return the meanings of the fields of a score class, keyed by field name."""
    return {name: field.description or "" for name, field in score.model_fields.items()}


def score_table(
    columns: Mapping[str, Mapping[str, float]], labels: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Return a table with one row per score. Each row contains the meaning of the score, and the value of the
    score for each print and baseline.
    """
    # A user-defined task need not describe its scores.
    names = dict.fromkeys(
        name for figures in columns.values() for name in figures if name in labels or not labels
    )
    return [
        {"name": name}
        | {title: figures.get(name, np.nan) for title, figures in columns.items()}
        | ({"meaning": labels[name]} if labels else {})
        for name in names
    ]


def level_table(design: Design) -> dict[str, Any]:
    """Return a table of the levels: nominal height, printed height, and printed height above level 0 in
    waves.
    """
    printed, step_um = design.stroke.printed_height_um, design.layout.level_height_um
    wave_um = design.optics.wave_height_um
    return {
        "level": range(len(printed)),
        "nominal_um": [level * step_um for level in range(len(printed))],
        "printed_um": printed,
        "printed_waves": [(height - printed[0]) / wave_um for height in printed],
    }
