"""Write the report of a plan: the open questions, the planned prints, the predicted differences between the
rivals (competing explanations), and the power to decide between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.layouts.statistics_report import layouts_figure
from litho_data.reports.page import Page, capitalised, filled
from litho_data.reports.pictures import new_figure
from litho_models.effects import FieldContext
from litho_models.planning.record import NextPrint
from litho_models.planning.rivalry import Rivalry, predict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN_LAYOUTS = 4
_COLUMNS = (
    "name",
    "status",
    "prints_needed",
    "difference_nm",
    "noise_nm",
    "form_nm",
    "text",
    "power",
    "random_power",
)


def write_report(
    folder: Path,
    plan: NextPrint,
    levels: Sequence[np.ndarray],
    rivalries: Mapping[str, Rivalry],
    shown: FieldContext,
) -> Path:
    """Write ``report.html`` and its tables ``questions.csv`` and ``order.csv``.

    Args:
        folder: folder of the plan.
        plan: the record.
        levels: the layout of each print.
        rivalries: the rivals of each question, keyed by the name of the question.
        shown: the last scan of the first print.
    """
    page = Page(
        f"What to print next: {plan.dataset.name}",
        f"{plan.prints} print{'s' * (plan.prints > 1)} with a side of {plan.field_um:g} µm, and "
        f"{len(plan.scans)} scans, including those of references.",
        run=plan.run,
        facts={"dataset": plan.dataset.sha256},
        words=Path(__file__).with_name("words.toml"),
    )
    page.verdict(filled(Path(__file__).with_name("verdict.jinja"), plan=plan).strip())
    first = {f"print {at}": level for at, level in enumerate(levels[:_SHOWN_LAYOUTS], start=1)}
    page.figure(
        layouts_figure(first, plan.levels),
        "Levels of the first prints. All prints consist of the same tiles, in a different order in each "
        "print.",
    )
    at = plan.prints - 1
    rows = [
        q.model_dump() | {"power": q.power[at], "random_power": q.random_power[at]} for q in plan.questions
    ]
    page.table(
        rows,
        "Open questions, and whether the plan decides them. The competing explanations of a question are "
        "called rivals.",
        "questions.csv",
        columns=_COLUMNS,
    )
    for question in plan.questions:
        page.heading(f"{question.name}: {question.status}", folded=True)
        page.paragraph(" ".join(f"{capitalised(text)}." for text in (question.text, question.why)))
        page.points([f"{capitalised(outcome)}." for outcome in question.outcomes])
        if question.rivals:
            page.figure(
                prints_figure(rivalries[question.name], shown),
                "Height that each rival predicts for the last scan of the first print (top row), and the "
                "difference of this prediction from that of the first rival (bottom row).",
            )
    page.heading("Scans", folded=True)
    page.table(plan.scans, "All scans in the order in which they must be made.", "order.csv")
    return page.write(folder)


def prints_figure(rivalry: Rivalry, shown: FieldContext) -> Figure:
    """Draw the height that each rival (competing explanation) predicts for a scan. Also draw the differences
    of these predictions from the prediction of the first rival.
    """
    maps = [predict(twin, shown).numpy() for twin in rivalry.twins.values()]
    changes = [NM_PER_UM * (own - maps[0] - (own - maps[0]).mean()) for own in maps]
    reach = np.percentile(np.abs(changes[1:]), 99)
    rows = (
        (maps, "viridis", np.min(maps), np.max(maps), "height, µm"),
        (changes, "RdBu_r", -reach, reach, "difference, nm"),
    )
    figure = new_figure(11, 5.5)
    axes = figure.subplots(2, len(maps), squeeze=False)
    for row, (images, colours, low, high, label) in zip(axes, rows, strict=True):
        for one, image in zip(row, images, strict=True):
            picture = one.imshow(image, cmap=colours, vmin=low, vmax=high)
            one.set_axis_off()
        figure.colorbar(picture, ax=row, label=label, shrink=0.7)
    for one, name in zip(axes[0], rivalry.twins, strict=True):
        one.set_title(name, fontsize=9)
    return figure
