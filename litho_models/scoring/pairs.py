"""Two sets of errors side by side, scan by scan: the difference, resampled over scans and over prints."""

from __future__ import annotations

from collections.abc import Sequence

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_models.scoring.records import ModelScores
from litho_models.scoring.statistics import FEWEST_FOR_INTERVAL, paired_difference, smallest_flip_p


class OverUnits(Record):
    """A mean difference when whole scans, or whole prints, are resampled and change their sign together.

    ``count``: of these; ``first_better``: in how many the first is smaller. ``ci95_nm``: bootstrap interval,
    None with fewer than ``FEWEST_FOR_INTERVAL``. ``p``: two-sided sign flips, which with so many cannot go
    below ``smallest_p``.
    """

    count: int
    first_better: int
    ci95_nm: tuple[float, float] | None
    p: float
    smallest_p: float


def over_units(
    first_nm: Sequence[float], second_nm: Sequence[float], groups: Sequence[str] | None = None, seed: int = 0
) -> OverUnits:
    """The difference of the errors of the same scans; ``groups``: the print of each, to resample prints."""
    found = paired_difference(list(first_nm), list(second_nm), groups=groups, seed=seed)
    return OverUnits(
        count=found.units,
        first_better=found.first_better,
        ci95_nm=found.interval if found.units >= FEWEST_FOR_INTERVAL else None,
        p=found.p,
        smallest_p=smallest_flip_p(found.units),
    )


class Paired(Record):
    """Mean over scans of first minus second ``mae_datum_free_nm``; negative means the first is better.

    ``over_prints``: the same with whole prints resampled; None in older result files.
    """

    first: str
    second: str
    mean_nm: float
    ci95_nm: tuple[float, float] | None
    p: float
    first_better: int
    scans: int
    over_prints: OverUnits | None = None


def paired_scores(first: ModelScores, second: ModelScores, seed: int = 0) -> Paired:
    """Compare the datum-free errors of the same scans, which meet by id: results list them by fold.

    Raises:
        InputError: scores of different scans.
    """
    errors = [{row.scan: row.mae_datum_free_nm for row in score.scans} for score in (first, second)]
    if errors[0].keys() != errors[1].keys():
        counts = " and ".join(str(len(found)) for found in errors)
        raise InputError("paired scores", got=f"{counts} scans", wanted="the same scans in both")
    pairs = list(errors[0].values()), [errors[1][scan] for scan in errors[0]]
    found = paired_difference(*pairs, seed=seed)
    return Paired(
        first=first.model,
        second=second.model,
        mean_nm=found.mean,
        ci95_nm=found.interval if found.units > 1 else None,
        p=found.p,
        first_better=found.first_better,
        scans=found.units,
        over_prints=over_units(*pairs, [row.print for row in first.scans], seed),
    )
