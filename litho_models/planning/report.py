"""The plan for people: what is open, what is printed for it, how the rivals differ there, and the power."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from litho_data.foundation.report import Page, capitalised
from litho_data.foundation.report_pictures import new_figure
from litho_data.foundation.units import NM_PER_UM
from litho_data.layouts.statistics_report import layouts_figure
from litho_models.planning.power import ENOUGH
from litho_models.planning.record import NextPrint, PlannedQuestion
from litho_models.planning.rivalry import PlannedPrint, Rivalry

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN_LAYOUTS = 4
_WORDS = {
    "asked": ("asked", ""),
    "power": ("power", f"chance that these prints give the right answer; {ENOUGH} or more decides"),
    "random_power": ("with random layouts", "the same, scanned alike, on random layouts"),
    "prints_needed": ("prints needed", f"for a power of {ENOUGH}"),
    "difference_nm": ("difference (nm)", "between the two nearest answers, root mean square over the prints"),
    "noise_nm": ("noise (nm)", "along that difference, for one pixel; large where neighbours are alike"),
    "form_nm": ("form (nm)", "the model's own error at most; twice as much of a difference decides nothing"),
}


def write_report(
    folder: Path,
    plan: NextPrint,
    levels: Sequence[np.ndarray],
    rivalries: Sequence[Rivalry],
    shown: PlannedPrint,
) -> Path:
    """Write ``report.html`` and ``questions.csv``; ``shown``: the print on which rivals are pictured."""
    page = Page(
        f"What to print next: {plan.dataset.name}",
        f"{plan.prints} print{'s' * (plan.prints > 1)} of {plan.field_um:g} µm in {len(plan.scans)} scans, "
        "three of them references.",
        run=plan.run,
        facts={"dataset": plan.dataset.sha256},
        words=_WORDS,
    )
    page.verdict(_verdict(plan))
    page.tiles(
        [
            (f"{plan.levels[0]} to {plan.levels[1]}", "levels used"),
            (f"{plan.smallest_feature_um:.2g} µm", "half a period of the finest structure"),
        ]
    )
    first = {f"print {place}": level for place, level in enumerate(levels[:_SHOWN_LAYOUTS], start=1)}
    page.figure(
        layouts_figure(first, plan.levels), "Levels of the first prints; tiles come in another order in each."
    )
    page.table(_table(plan), "Open questions, and what the plan makes of them.", "questions.csv")
    for question in plan.questions:
        page.heading(f"{question.name}: {question.status}", folded=True)
        page.paragraph(f"{_sentence(question.text)} {_sentence(question.why)}")
        page.points([_sentence(outcome) for outcome in question.outcomes])
        rivalry = next((r for r in rivalries if r.question.name == question.name), None)
        if rivalry is not None:
            page.figure(
                prints_figure(rivalry, shown),
                "What each rival predicts of the first print as the last of its scans shows it, and what it "
                "has more than the first rival, nm.",
            )
        if question.kind != "fact":
            page.figure(
                _power_figure(question), "Probability of a right decision; grey: with random layouts."
            )
    page.heading("Scans", folded=True)
    page.table(plan.scans, "In the order of scanning.", "order.csv")
    return page.write(folder)


def _verdict(plan: NextPrint) -> str:
    decided = [q.text for q in plan.questions if q.status == "decides"]
    asked = sum(question.kind != "fact" for question in plan.questions)
    if not asked:
        names = " and ".join(question.name for question in plan.questions)
        return f"No print decides what is open: a fact on the card answers {names}."
    told = f": {'; '.join(decided)}." if decided else "."
    return (
        f"These prints decide {len(decided)} of {asked} open questions with a chance of {ENOUGH} or more of "
        f"being right{told}{_wanting(plan)}"
    )


def _wanting(plan: NextPrint) -> str:
    """What no print answers."""
    names = [question.name for question in plan.questions if question.kind == "fact"]
    return f" A fact on the card, and no print, answers {' and '.join(names)}." if names else ""


def _needed(question: PlannedQuestion) -> str:
    if question.kind == "fact":
        return "–"
    return f"over {len(question.power)}" if question.prints_needed is None else str(question.prints_needed)


def _sentence(text: str) -> str:
    return f"{capitalised(text)}."


def _table(plan: NextPrint) -> list[dict[str, Any]]:
    return [
        {
            "question": q.name,
            "status": q.status,
            "power": math.nan if q.kind == "fact" else q.power[plan.prints - 1],
            "random_power": math.nan if q.kind == "fact" else q.random_power[plan.prints - 1],
            "prints_needed": _needed(q),
            "difference_nm": np.nan if q.difference_nm is None else q.difference_nm,
            "noise_nm": np.nan if q.noise_nm is None else q.noise_nm,
            "form_nm": np.nan if q.form_nm is None else q.form_nm,
            "asked": q.text,
        }
        for q in plan.questions
    ]


def prints_figure(rivalry: Rivalry, shown: PlannedPrint) -> Figure:
    with torch.no_grad():
        maps = [rivalry.printing.predict(chain, shown, shown.ways[-1]).numpy() for chain in rivalry.chains]
    figure = new_figure(11, 5.5)
    changes = [NM_PER_UM * (own - maps[0]) for own in maps]
    reach = max(float(np.percentile(np.abs(change - change.mean()), 99)) for change in changes[1:])
    for place, (rival, own, change) in enumerate(zip(rivalry.question.rivals, maps, changes, strict=True)):
        axes = figure.add_subplot(2, len(maps), place + 1)
        axes.imshow(own, cmap="viridis")
        axes.set_title(rival.name, fontsize=9)
        axes.set_axis_off()
        axes = figure.add_subplot(2, len(maps), len(maps) + place + 1)
        picture = axes.imshow(change - change.mean(), cmap="RdBu_r", vmin=-reach, vmax=reach)
        axes.set_axis_off()
    figure.colorbar(picture, ax=figure.axes[1::2], label="nm", shrink=0.7)
    return figure


def _power_figure(question: PlannedQuestion) -> Figure:
    figure = new_figure(6, 3)
    axes = figure.add_subplot(1, 1, 1, xlabel="prints", ylabel="power")
    counts = np.arange(1, len(question.power) + 1)
    axes.plot(counts, question.random_power, color="0.7")
    axes.plot(counts, question.power, marker="o")
    axes.axhline(ENOUGH, color="0.5", linestyle=":")
    axes.set_ylim(0, 1.02)
    return figure
