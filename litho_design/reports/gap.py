"""The report of a comparison: tables with intervals and the images in design and after printing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.reports.page import Page, capitalised
from litho_design.holograms.bench import HologramScore
from litho_design.judging.gap import GapResult, PairedDifference, design_folder
from litho_design.judging.loaded import LoadedDesign, task_named
from litho_design.lenses.score import ImagingLensScore
from litho_design.printers.printer import Printer
from litho_design.reports.advice import WORDS, baseline_line, called, named
from litho_design.reports.parts import meanings, picture_grid
from litho_design.tasks.design import Design

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# With fewer seeds, an interval over them is missing or meaningless.
_FEWEST_SEEDS = 3
# For each arm a design, and the image behind each judge's print.
_Judged = dict[str, tuple[LoadedDesign, dict[str, np.ndarray]]]
_LABELS = meanings(HologramScore) | meanings(ImagingLensScore)


def write_gap_report(folder: Path, result: GapResult, printers: Mapping[str, Printer]) -> Path:
    """Write ``report.html`` and one CSV per table."""
    what = (
        f"hologram of “{result.target}”"
        if result.task == "hoe"
        else result.task.replace("lens-", "lens, ").replace("-", " ")
    )
    shown = task_named(result.task).headline
    page = Page(
        "The design-to-manufacturing gap",
        f"{capitalised(what)}, designed with {_listed(result.arms)}; {result.settings.search.iterations} "
        f"iterations each, seed{'s' * (len(result.seeds) > 1)} {_listed(result.seeds)}. Layouts are scored "
        "as they would be printed.",
        run=result,
        facts={"seeds": ", ".join(map(str, result.seeds))}
        | {f"{name}, SHA-256": one.sha256 for name, one in result.judges.items() if one.sha256},
        words=WORDS,
    )
    own = Design.read(design_folder(folder, next(iter(result.arms)), result.seeds[0]))
    shown = shown or tuple(own.predicted)
    page.verdict(_verdict(result, shown[0]))
    judged = _judged(folder, result, printers)
    page.figure(
        _pictures(judged),
        f"Seed {result.seeds[0]}. Above each image: what it was designed with, and what printed it. "
        + (
            "Square root of the PSF over its peak." if result.task.startswith("lens-") else "Scaled to match."
        ),
    )
    page.note(*(f"{capitalised(note)}." for note in own.notes))
    page.paragraph(
        "An arm is a model that layouts are designed with (rows); a judge is a model that prints them "
        "(columns). On the diagonal a model judges its own design: that is its expectation, not an "
        "independent result."
    )
    page.table(_matrix(result, shown[0]), _caption(result.task, shown[0]), f"matrix_{shown[0]}.csv", digits=3)
    if own.baselines:
        line = baseline_line(own.baselines)
        page.paragraph(f"{capitalised(line)}. No printer is involved in these.")
    page.heading("Further figures", folded=True)
    for figure in shown[1:]:
        page.table(_matrix(result, figure), _caption(result.task, figure), f"matrix_{figure}.csv", digits=3)
    page.heading("Reports of the designs", folded=True)
    page.links(
        [
            (
                (design_folder(Path(), arm, seed) / "report.html").as_posix(),
                f"Designed with {arm}, seed {seed}",
            )
            for arm in result.arms
            for seed in result.seeds
        ]
    )
    if result.paired:
        page.heading("Arm against arm", folded=True)
        page.paragraph("Differences under the same judge, paired by seed. If 0 is inside, the order is open.")
        pairs = [
            one.model_dump(exclude={"ci95"})
            | dict(zip(("95 % from", "to"), one.ci95 or (np.nan, np.nan), strict=True))
            for one in result.paired
        ]
        page.table(pairs, "Paired differences", "paired.csv", digits=3)
    means = [one.model_dump(exclude={"judged_ci95"}) for one in result.summary]
    page.table(means, "All means", "summary.csv", digits=4)
    return page.write(folder)


def _verdict(result: GapResult, figure: str) -> str:
    """The best arm under each judge that is no arm, or else under every judge."""
    judges = [name for name in result.judges if name not in result.arms] or list(result.judges)
    sign = -1 if figure in task_named(result.task).errors else 1
    unit = " dB" if figure.endswith("_db") else ""
    told = []
    for judge in judges:
        found = {i.arm: i.judged_mean for i in result.summary if (i.judge, i.figure) == (judge, figure)}
        ranking = sorted(found, key=lambda arm: -sign * found[arm])
        text = (
            f"Printed by {called(judge)}, layouts designed with {called(ranking[0])} are best: "
            f"{found[ranking[0]]:.4g}{unit}"
        )
        if len(ranking) > 1:
            pair = next(
                i
                for i in result.paired
                if (i.judge, i.figure) == (judge, figure) and {i.arm, i.against} == set(ranking[:2])
            )
            text += f", against {found[ranking[1]]:.4g}{unit} with {called(ranking[1])}; " + _chance(
                pair, len(result.seeds)
            )
        told.append(f"{text}.")
    return f"{' '.join(told)} The figure is the {_label(figure)}."


def _chance(pair: PairedDifference, seeds: int) -> str:
    if pair.ci95 is None or seeds < _FEWEST_SEEDS:
        return f"{seeds} seed{'s' * (seeds > 1)} cannot tell that from chance"
    low, high = pair.ci95
    sure = "more than chance" if low > 0 or high < 0 else "which may be chance"
    return f"{sure} (95 % interval of the difference over {seeds} seeds {low:.3g} … {high:.3g})"


def _caption(task: str, figure: str) -> str:
    better = "less" if figure in task_named(task).errors else "more"
    return f"{capitalised(_label(figure))}: mean over seeds [95 % interval]; {better} is better."


def _label(figure: str) -> str:
    """The meaning of a figure; figures of your own tasks have only a name."""
    return _LABELS.get(figure) or named(figure)


def _listed(things: Iterable[object]) -> str:
    *first, last = map(str, things)
    return f"{', '.join(first)} and {last}" if first else last


def _matrix(result: GapResult, figure: str) -> list[dict[str, Any]]:
    rows = []
    for arm in result.arms:
        row: dict[str, str] = {"designed with": arm}
        for item in result.summary:
            if item.arm == arm and item.figure == figure:
                interval = "" if item.judged_ci95 is None else " [{:.3f}, {:.3f}]".format(*item.judged_ci95)
                row[f"printed by {item.judge}"] = f"{item.judged_mean:.3f}{interval}"
        rows.append(row)
    return rows


def _judged(folder: Path, result: GapResult, printers: Mapping[str, Printer]) -> _Judged:
    """For every arm, the image (or PSF) behind each judge's print, first seed."""
    images = {}
    for arm, own in printers.items():
        if arm not in result.arms:
            continue
        loaded = LoadedDesign(design_folder(folder, arm, result.seeds[0]), device=own.device)
        images[arm] = (
            loaded,
            {name: loaded.image(loaded.printed_um(judge)) for name, judge in printers.items()},
        )
    return images


def _pictures(judged: _Judged) -> Figure:
    target = next(iter(judged.values()))[0].target
    wanted = {} if target is None else {"wanted": target.cpu().numpy()}
    rows = {
        arm: wanted
        | {
            f"{arm}:\n{'in design' if name == arm else f'printed by {name}'}": loaded.display(image)
            for name, image in by_judge.items()
        }
        for arm, (loaded, by_judge) in judged.items()
    }
    return picture_grid(rows, next(iter(judged.values()))[0].window_um)
