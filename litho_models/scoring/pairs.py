"""Two sets of errors side by side, scan by scan: the difference, resampled over scans and over prints."""

from __future__ import annotations

from collections.abc import Sequence

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_models.scoring.records import ModelScores
from litho_models.scoring.statistics import FEWEST_FOR_INTERVAL, paired_difference, smallest_flip_p


class OverUnits(Record):
    """The mean over scans of a difference, where whole scans or whole prints are resampled and change sign.

    ``count``: of these; ``positive``: in how many the difference is above zero. ``ci95_nm``: bootstrap
    interval, None with fewer than ``FEWEST_FOR_INTERVAL``. ``p``: two-sided sign flips, which with so many
    cannot go below ``smallest_p``.
    """

    count: int
    positive: int
    ci95_nm: tuple[float, float] | None
    p: float
    smallest_p: float


def over_scans(differences_nm: Sequence[float], seed: int = 0) -> OverUnits:
    """A difference per scan, resampled over scans."""
    return _over_units(differences_nm, None, seed)


def over_prints(differences_nm: Sequence[float], prints: Sequence[str], seed: int = 0) -> OverUnits | None:
    """A difference per scan, resampled over the ``prints`` of the scans; None for a single print."""
    return _over_units(differences_nm, prints, seed) if len(set(prints)) > 1 else None


def _over_units(differences_nm: Sequence[float], groups: Sequence[str] | None, seed: int) -> OverUnits:
    differences = list(differences_nm)
    found = paired_difference(differences, [0.0] * len(differences), groups=groups, seed=seed)
    return OverUnits(
        count=found.units,
        positive=found.second_better,
        ci95_nm=found.interval if found.units >= FEWEST_FOR_INTERVAL else None,
        p=found.p,
        smallest_p=smallest_flip_p(found.units),
    )


class Paired(Record):
    """Mean over scans of first minus second leading error; negative means the first is better.

    ``over_prints``: the same with whole prints resampled; None for a single print, or in older result files.
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
    """Compare the leading errors of the same scans, which meet by id: results list them by fold.

    Raises:
        InputError: scores of different scans.
    """
    errors = [score.leading_of_scans_nm for score in (first, second)]
    if errors[0].keys() != errors[1].keys():
        counts = " and ".join(str(len(found)) for found in errors)
        raise InputError("paired scores", got=f"{counts} scans", wanted="the same scans in both")
    pairs = list(errors[0].values()), [errors[1][scan] for scan in errors[0]]
    found = paired_difference(*pairs, seed=seed)
    differences = [a - b for a, b in zip(*pairs, strict=True)]
    return Paired(
        first=first.model,
        second=second.model,
        mean_nm=found.mean,
        ci95_nm=found.interval if found.units >= FEWEST_FOR_INTERVAL else None,
        p=found.p,
        first_better=found.first_better,
        scans=found.units,
        over_prints=over_prints(differences, [row.print for row in first.scans], seed),
    )
