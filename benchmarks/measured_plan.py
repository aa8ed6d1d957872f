"""Copy the plan for new prints on the measured printer into the documentation, with the files for the
laboratory, the tables and the picture.

    litho-models next-print runs/neural-lithography/close-loop --out runs/neural-lithography/next-print
        --steps 20
    python -m benchmarks.measured_plan runs/neural-lithography/next-print

The plan is copied into docs/results without its report and its CSV tables, and the tables of the page are
written anew.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from benchmarks.markdown_table import markdown_table
from benchmarks.record import options, publish
from litho_data.commands.progress import run_script
from litho_data.layouts.statistics_report import layouts_figure
from litho_data.readers.layout import read_layout
from litho_models.planning.record import NextPrint
from litho_models.planning.run import HOLDS

PAGE = Path(__file__).parents[1] / "docs" / "next_print.md"
RESULTS = PAGE.parent / "results" / "next-print"
_LEFT_OUT = ("report.html", "*.csv")


def main() -> None:
    """Copy the plan, draw its layouts, and write the tables into the page."""
    parser = options(__doc__)
    parser.add_argument(
        "plan", type=Path, help="folder of the plan that was made from the closed loop on the measured prints"
    )
    given = parser.parse_args()
    plan = NextPrint.read(given.plan)
    shutil.rmtree(RESULTS, ignore_errors=True)
    for name in HOLDS:
        for source in given.plan.glob(name) if name not in _LEFT_OUT else ():
            copy = RESULTS / source.relative_to(given.plan)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, copy)
    draw(plan)
    for name, text in texts(plan).items():
        publish(PAGE, name, text)


def draw(plan: NextPrint) -> None:
    """Draw the layouts of the planned prints side by side."""
    first = {scan.print: scan.id for scan in reversed(plan.scans) if scan.use == "dataset"}
    levels = {
        f"print {name}": read_layout(RESULTS / "layouts" / f"{first[name]}.tif") for name in sorted(first)
    }
    layouts_figure(levels, plan.levels).savefig(RESULTS / "layouts.jpg", dpi=80)


def texts(plan: NextPrint) -> dict[str, str]:
    """Return the texts to publish on the page, by the names of their marks."""
    count = plan.prints

    def number(value: float | None, digits: int = 1) -> str:
        return "–" if value is None else f"{value:.{digits}f}"

    questions = [
        (
            q.name,
            str(len(q.rivals) or "–"),
            number(q.difference_nm),
            number(q.random_difference_nm),
            number(q.noise_nm),
            number(q.form_nm),
            "–" if q.kind == "fact" else f"{q.power[count - 1]:.2f}",
            "–" if q.prints_needed is None else str(q.prints_needed),
            q.status,
        )
        for q in plan.questions
    ]
    pairs = [
        (*pair.rivals, number(pair.difference_nm), number(pair.noise_nm), f"{pair.power[count - 1]:.2f}")
        for q in plan.questions
        for pair in q.pairs
    ]
    heads = (
        "question",
        "competing explanations (rivals)",
        "difference of their predictions, nm rms",
        "the same difference with random layouts, nm rms",
        "noise along the difference, nm rms",
    )
    more = (
        "error of the model, nm",
        f"power with {count} prints",
        "number of prints for a power of 0.95",
        "status",
    )
    of_pairs = (
        "rival",
        "other rival",
        "difference of their predictions, nm rms",
        "noise along the difference, nm rms",
        f"power with {count} prints",
    )
    return {
        "measured questions": markdown_table((*heads, *more), questions),
        "measured rivals": markdown_table(of_pairs, pairs),
    }


if __name__ == "__main__":
    run_script(main)
