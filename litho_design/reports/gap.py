"""Write the report of a comparison: tables with confidence intervals, and the images behind the prints that
the judges predict.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.reports.page import Page, capitalised
from litho_design.holograms.bench import HologramScore
from litho_design.judging.gap import GapResult, GapSummary, PairedDifference, design_folder
from litho_design.lenses.score import ImagingLensScore
from litho_design.reports.advice import WORDS, baseline_line, called, named
from litho_design.reports.pictures import Panel, panels_figure
from litho_design.reports.tables import meanings
from litho_design.tasks.design import Design
from litho_design.tasks.task import registered_task

# With fewer seeds, a confidence interval over seeds is missing or meaningless.
_FEWEST_SEEDS = 3
_LABELS = meanings(HologramScore) | meanings(ImagingLensScore)


def write_gap_report(folder: Path, result: GapResult, pictures: Sequence[Sequence[Panel]]) -> Path:
    """Write ``report.html`` and one CSV per table.

    ``pictures`` contains one row of images per arm, all for the first seed.
    """
    lens = result.task.startswith("lens-")
    what = result.task.replace("lens-", "lens, ").replace("-", " ")
    what = f"hologram of “{result.target}”" if result.task == "hoe" else what
    page = Page(
        "The design-to-manufacturing gap",
        f"{capitalised(what)}, designed with {_listed(result.arms)} "
        f"({result.settings.search.iterations} iterations per design; seed{'s' * (len(result.seeds) > 1)} "
        f"{_listed(result.seeds)}). Layouts are scored as they would be printed.",
        run=result,
        facts={"seeds": ", ".join(map(str, result.seeds))}
        | {f"{name}, SHA-256": one.sha256 for name, one in result.judges.items() if one.sha256},
        words=WORDS,
    )
    own = Design.read(design_folder(folder, next(iter(result.arms)), result.seeds[0]))
    shown = registered_task(result.task).headline or tuple(own.predicted)
    page.verdict(_verdict(result, shown[0]))
    page.figure(
        panels_figure(pictures),
        f"Seed {result.seeds[0]}. Each title names the arm that designed the layout and the judge "
        "that printed it. "
        + ("Each image shows sqrt(PSF / peak)." if lens else "Each image is scaled to match the target."),
    )
    page.note(*(f"{capitalised(note)}." for note in own.notes))
    page.paragraph(
        "An arm is a model that layouts are designed with (rows); a judge is a model that prints them "
        "(columns). On the diagonal, a model judges its own design, so the score is its own "
        "prediction, not an independent result."
    )
    for figure in shown:
        page.table(_matrix(result, figure), _caption(result.task, figure), f"matrix_{figure}.csv", digits=3)
        if figure == shown[0]:
            if own.baselines:
                line = capitalised(baseline_line(own.baselines))
                page.paragraph(f"{line}. These baselines involve no printer.")
            page.heading("Further figures", folded=True)
    page.heading("Reports of the designs", folded=True)
    page.links(
        [
            (
                f"{design_folder(Path(), arm, seed).as_posix()}/report.html",
                f"Designed with {arm}, seed {seed}",
            )
            for arm in result.arms
            for seed in result.seeds
        ]
    )
    if result.paired:
        page.heading("Arm against arm", folded=True)
        page.paragraph(
            "Differences between two arms under the same judge, paired by seed. If a confidence interval "
            "includes 0, the order of the arms is undecided."
        )
        pairs = [
            one.model_dump(exclude={"ci95"})
            | dict(zip(("95 % from", "to"), one.ci95 or (np.nan, np.nan), strict=True))
            for one in result.paired
        ]
        page.table(pairs, "Paired differences", "paired.csv", digits=3)
    means = [one.model_dump(exclude={"judged_ci95"}) for one in result.summary]
    page.table(means, "Mean of every figure, for every arm and judge", "summary.csv", digits=4)
    return page.write(folder)


def _means(result: GapResult, figure: str, judge: str) -> dict[str, GapSummary]:
    """Return the mean and the confidence interval of one score according to one judge, keyed by arm."""
    return {one.arm: one for one in result.summary if (one.judge, one.figure) == (judge, figure)}


def _verdict(result: GapResult, figure: str) -> str:
    """Return sentences that name the best arm (model used for design) according to each judge. If there are
    judges that are not arms, the sentences are only about these judges.
    """
    judges = [name for name in result.judges if name not in result.arms] or list(result.judges)
    sign = 1 if figure in registered_task(result.task).errors else -1
    unit = " dB" if figure.endswith("_db") else ""
    told = []
    for judge in judges:
        found = {arm: one.judged_mean for arm, one in _means(result, figure, judge).items()}
        best, *others = sorted(found, key=lambda arm: sign * found[arm])
        text = (
            f"If {called(judge)} prints the layouts, those designed with {called(best)} are best: "
            f"{found[best]:.4g}{unit}"
        )
        if others:
            pair = next(
                one
                for one in result.paired
                if (one.judge, one.figure, {one.arm, one.against}) == (judge, figure, {best, others[0]})
            )
            text += f", against {found[others[0]]:.4g}{unit} with {called(others[0])}; "
            text += _chance(pair, len(result.seeds))
        told.append(f"{text}.")
    return f"{' '.join(told)} The figure is the {_label(figure)}."


def _chance(pair: PairedDifference, seeds: int) -> str:
    if pair.ci95 is None or seeds < _FEWEST_SEEDS:
        return f"{seeds} seed{'s' * (seeds > 1)} cannot tell this difference from chance"
    low, high = pair.ci95
    sure = "this is more than chance" if low > 0 or high < 0 else "this may be chance"
    return f"{sure} (95 % confidence interval of the difference over {seeds} seeds: {low:.3g} to {high:.3g})"


def _caption(task: str, figure: str) -> str:
    better = "lower" if figure in registered_task(task).errors else "higher"
    return f"{capitalised(_label(figure))}: mean over seeds [95 % confidence interval]; {better} is better."


def _label(figure: str) -> str:
    """Return the meaning of a score, or its readable name if its meaning is unknown, as in a user-defined
    task.
    """
    return _LABELS.get(figure) or named(figure)


def _listed(things: Iterable[object]) -> str:
    *first, last = map(str, things)
    return f"{', '.join(first)} and {last}" if first else last


def _matrix(result: GapResult, figure: str) -> list[dict[str, Any]]:
    rows: dict[str, dict[str, Any]] = {arm: {"designed with": arm} for arm in result.arms}
    for judge in result.judges:
        for arm, one in _means(result, figure, judge).items():
            interval = "" if one.judged_ci95 is None else " [{:.3f}, {:.3f}]".format(*one.judged_ci95)
            rows[arm][f"printed by {judge}"] = f"{one.judged_mean:.3f}{interval}"
    return list(rows.values())
