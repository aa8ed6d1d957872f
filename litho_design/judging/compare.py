"""The design-to-manufacturing gap: every arm's design printed by every judge, over seeds."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Literal, TypeVar

import numpy as np
from pydantic import Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.outputs import require_own_folder
from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunFacts, run_facts
from litho_design.judging.judge import Judging
from litho_design.printers.printer import Printer, PrinterRecord
from litho_design.reports.gap import write_gap_report
from litho_design.tasks.design import Design, DesignTask
from litho_design.tasks.settings import HoeSettings, LensSettings

HEADLINE = {
    "hoe": ("si_psnr_db", "ssim", "ssim_camera", "eff_signal", "speckle_contrast"),
    "lens-direct": ("cbr", "strehl", "focusing_efficiency", "fwhm_um"),
    "lens-computational": ("mae_design", "mae_calibrated", "ssim_calibrated", "strehl", "cbr"),
}


class GapEntry(Record):
    """One design (arm, seed) printed by one judge; ``designed`` is the arm's own expectation."""

    arm: str
    seed: int
    judge: str
    self_judged: bool
    designed: dict[str, float]
    judged: dict[str, float]
    rms_height_gap_um: float


class GapSummary(Record):
    """One figure of one arm under one judge: mean over seeds with its 95 % interval."""

    arm: str
    judge: str
    figure: str
    designed_mean: float
    judged_mean: float
    judged_ci95: tuple[float, float] | None
    gap_mean: float
    seeds: int


class PairedDifference(Record):
    """One figure of one arm minus that of another under the same judge, paired by seed."""

    judge: str
    figure: str
    arm: str
    against: str
    mean: float
    ci95: tuple[float, float] | None


class GapResult(RunFacts, Result):
    """gap.json."""

    SCHEMA: ClassVar[str] = "litho-design/gap/1"
    FILE_NAME: ClassVar[str] = "gap.json"

    schema_: Literal["litho-design/gap/1"] = Field(default="litho-design/gap/1", alias="schema")
    task: DesignTask
    settings: HoeSettings | LensSettings
    target: str
    seeds: list[int]
    arms: dict[str, PrinterRecord]
    judges: dict[str, PrinterRecord]
    entries: list[GapEntry]
    summary: list[GapSummary]
    paired: list[PairedDifference]


S = TypeVar("S", HoeSettings, LensSettings)


def compare(
    settings: S,
    designer: Callable[[S, Printer, Path], Design],
    arms: Mapping[str, Printer],
    judges: Mapping[str, Printer],
    out: str | Path,
    *,
    seeds: Sequence[int],
) -> GapResult:
    """Design once per arm and seed with equal budgets, and print each layout with every judge.

    All arms share every setting but the printer; a finished or interrupted design in ``out`` is
    used again or continued. The arms' own printers judge too, so that the whole matrix is there.

    Args:
        settings: the task; only the seed of its search is changed.
        designer: settings, printer and folder to a design (``design_hoe`` or ``design_lens``).
        arms: name to printer.
        judges: further printers that only judge.
        seeds: one design per arm and seed.

    Returns:
        The record written to ``out/gap.json``.

    Raises:
        InputError: no arm or no seed, a judge with the name of an arm, or an ``out`` that holds another
            kind of result.
    """
    _check(arms, judges, seeds)
    folder = Path(out)
    require_own_folder(folder, GapResult.FILE_NAME)
    everyone = {**arms, **judges}
    entries: list[GapEntry] = []
    for (arm, printer), seed in itertools.product(arms.items(), seeds):
        search = settings.search.model_copy(update={"seed": seed})
        place = design_folder(folder, arm, seed)
        design = designer(settings.model_copy(update={"search": search}), printer, place)
        judging = Judging(place, device=printer.device)
        expected = judging.printed_um(printer)
        for name, judge in everyone.items():
            printed = judging.printed_um(judge)
            entries.append(
                GapEntry(
                    arm=arm,
                    seed=seed,
                    judge=name,
                    self_judged=name == arm,
                    designed=judging.design.predicted,
                    judged=judging.figures(printed).model_dump(),
                    rms_height_gap_um=float((printed - expected).square().mean().sqrt()),
                )
            )
    result = GapResult(
        task=design.task,
        **run_facts(),
        settings=settings,
        target=design.target.name if design.target else "",
        seeds=list(seeds),
        arms={name: printer.record() for name, printer in arms.items()},
        judges={name: printer.record() for name, printer in everyone.items()},
        entries=entries,
        summary=summarise(entries),
        paired=paired_differences(entries, HEADLINE[design.task]),
    )
    write_gap_report(folder, result, everyone)
    result.write(folder)
    return result


def design_folder(out: Path, arm: str, seed: int) -> Path:
    """Where the design of one arm and seed lies."""
    return out / "designs" / arm / f"seed{seed}"


def summarise(entries: Sequence[GapEntry]) -> list[GapSummary]:
    """Mean, interval and gap of every figure for every arm and judge."""
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
    """The given figures of every arm against every other one, under each judge."""
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
    """Student's t interval of the mean; None for a single value."""
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


def _check(arms: Mapping[str, Printer], judges: Mapping[str, Printer], seeds: Sequence[int]) -> None:
    if not arms or not seeds:
        raise InputError(
            "comparison", got=f"{len(arms)} arms, {len(seeds)} seeds", wanted="at least one of each"
        )
    both = sorted(set(arms) & set(judges))
    if both:
        raise InputError(
            "judges", got=f"{both[0]!r} twice", wanted="names that no arm has", hint="arms judge anyway"
        )
