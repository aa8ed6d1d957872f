"""Records of the design-to-manufacturing gap. Each arm (a model used for design) makes one design per seed.
Each judge (the same model or another model) predicts the prints of all designs, and these prints are scored.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunFacts
from litho_design.holograms.settings import HologramSettings
from litho_design.lenses.settings import LensSettings
from litho_design.optimisation.settings import DesignSettings
from litho_design.printers.printer import PrinterRecord
from litho_design.reliefs.settings import ReliefSettings
from litho_design.tasks.design import DESIGNS


class GapEntry(Record):
    """One design (of one arm and one seed), with the scores of the print that one judge predicts.
    ``designed`` contains the scores of the print as predicted by the arm's own model.
    """

    arm: str
    seed: int
    judge: str
    self_judged: bool
    designed: dict[str, float]
    judged: dict[str, float]
    rms_height_gap_um: float


class GapSummary(Record):
    """The mean of one score over the designs of one arm (one design per seed), with a 95 % confidence
    interval. The same judge predicts all prints.
    """

    arm: str
    judge: str
    figure: str
    designed_mean: float
    judged_mean: float
    judged_ci95: tuple[float, float] | None
    gap_mean: float
    seeds: int


class PairedDifference(Record):
    """The difference in one score between designs of two arms with the same seed, averaged over the seeds.
    The same judge predicts all prints.
    """

    judge: str
    figure: str
    arm: str
    against: str
    mean: float
    ci95: tuple[float, float] | None


class GapResult(RunFacts, Result):
    """The contents of gap.json."""

    SCHEMA: ClassVar[str] = "litho-design/gap/1"
    FILE_NAME: ClassVar[str] = "gap.json"

    task: str
    # The type with the fewest fields comes first. It fits the settings of a user-defined task, which have
    # only the fields common to all designs.
    settings: DesignSettings | ReliefSettings | HologramSettings | LensSettings
    target: str
    seeds: list[int]
    arms: dict[str, PrinterRecord]
    judges: dict[str, PrinterRecord]
    entries: list[GapEntry]
    summary: list[GapSummary]
    paired: list[PairedDifference]


def design_folder(out: Path, arm: str, seed: int) -> Path:
    """Return the folder of the design of one arm and seed."""
    return out / DESIGNS / arm / f"seed{seed}"


def summarise(entries: Sequence[GapEntry]) -> list[GapSummary]:
    """Return one summary for every score, arm and judge: the mean with its confidence interval, and the mean
    gap, i.e. the designed score minus the judged score.
    """
    summary = []
    for (arm, judge), group in _grouped(entries).items():
        for figure in group[0].judged:
            judged = np.array([entry.judged[figure] for entry in group])
            designed = np.array([entry.designed[figure] for entry in group])
            summary.append(
                GapSummary(
                    arm=arm,
                    judge=judge,
                    figure=figure,
                    designed_mean=float(designed.mean()),
                    judged_mean=float(judged.mean()),
                    judged_ci95=interval95(judged),
                    gap_mean=float((designed - judged).mean()),
                    seeds=len(group),
                )
            )
    return summary


def paired_differences(entries: Sequence[GapEntry], figures: Sequence[str]) -> list[PairedDifference]:
    """Return the differences in the given scores, for every pair of arms and every judge."""
    groups = _grouped(entries)
    arms = list(dict.fromkeys(entry.arm for entry in entries))
    judges = list(dict.fromkeys(entry.judge for entry in entries))
    differences = []
    for judge, figure in itertools.product(judges, figures):
        for against, arm in itertools.combinations(arms, 2):
            pairs = zip(groups[arm, judge], groups[against, judge], strict=True)
            values = np.array([one.judged[figure] - other.judged[figure] for one, other in pairs])
            differences.append(
                PairedDifference(
                    judge=judge, figure=figure, arm=arm, against=against,
                    mean=float(values.mean()), ci95=interval95(values),
                )
            )  # fmt: skip
    return differences


def interval95(values: np.ndarray) -> tuple[float, float] | None:
    """Return the 95 % confidence interval of the mean (Student's t); None for a single value."""
    if len(values) < 2:
        return None
    from scipy.stats import t

    half = float(t.ppf(0.975, len(values) - 1)) * float(values.std(ddof=1)) / math.sqrt(len(values))
    return float(values.mean()) - half, float(values.mean()) + half


def _grouped(entries: Sequence[GapEntry]) -> dict[tuple[str, str], list[GapEntry]]:
    groups: dict[tuple[str, str], list[GapEntry]] = {}
    for entry in entries:
        groups.setdefault((entry.arm, entry.judge), []).append(entry)
    return groups
