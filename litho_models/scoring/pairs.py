"""Two models side by side, scan by scan."""

from __future__ import annotations

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_models.scoring.records import ModelScores
from litho_models.scoring.statistics import paired_difference


class Paired(Record):
    """Mean over scans of first minus second ``mae_datum_free_nm``; negative means the first is better."""

    first: str
    second: str
    mean_nm: float
    ci95_nm: tuple[float, float] | None
    p: float
    first_better: int
    scans: int


def paired_scores(first: ModelScores, second: ModelScores, seed: int = 0) -> Paired:
    """Compare the datum-free errors of the same scans, which meet by id: results list them by fold.

    Raises:
        InputError: scores of different scans.
    """
    errors = [{row.scan: row.mae_datum_free_nm for row in score.scans} for score in (first, second)]
    if errors[0].keys() != errors[1].keys():
        counts = " and ".join(str(len(found)) for found in errors)
        raise InputError("paired scores", got=f"{counts} scans", wanted="the same scans in both")
    found = paired_difference(list(errors[0].values()), [errors[1][scan] for scan in errors[0]], seed=seed)
    return Paired(
        first=first.model,
        second=second.model,
        mean_nm=found.mean,
        ci95_nm=found.interval if found.scans > 1 else None,
        p=found.p,
        first_better=found.first_better,
        scans=found.scans,
    )
