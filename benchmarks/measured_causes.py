"""Publish the results of the closed loop on the measured prints, as a record, tables and a picture.

litho-models close-loop runs/neural-lithography/store.zarr --nested prints --out runs/causes
python -m benchmarks.measured_causes runs/causes
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.markdown_table import markdown_table, with_interval
from benchmarks.record import options, publish
from litho_data.commands.progress import run_script
from litho_data.reports.pictures import new_figure
from litho_models.effects.laws import TABLES
from litho_models.loop.record import CloseLoop, ErrorRow, FoundEffect

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "measured_prints.md"
FOLDER = ROOT / "docs" / "results" / "neural-lithography" / "causes"
PICTURE = "errors.png"
_MODELS = {"base": "base model", "causes": "with the causes", "all": "with all findings"}
_MEASURED = {
    "print alone": "nothing",
    "published": "the shared smooth background (protocol of the benchmark)",
    "shared": "the measurement model",
}
_HELD_OUT = {
    "scans": "five folds of scans",
    "prints": "whole prints (causes chosen with them)",
    "nested prints": "whole prints (everything chosen without them)",
    "nested folds": "five folds of scans (everything chosen without them)",
}


def texts(result: CloseLoop) -> dict[str, str]:
    """Return the texts to publish on the page, by the names of their marks."""
    return {"errors": errors_table(result), "causes": causes_table(result)}


def errors_table(result: CloseLoop) -> str:
    """Return the table of errors. It has a row for each combination of model, measurement model and way of
    holding out scans.
    """
    keys = dict.fromkeys((row.model, row.measurement, row.held_out) for row in result.errors)
    rows = []
    for model, measurement, held_out in keys:
        one = {policy: result.error(model, policy, measurement, held_out) for policy in ("offset", "full")}
        first = one["offset"]
        assert first is not None
        assert one["full"] is not None
        rows.append(
            [
                _MODELS[model],
                _MEASURED[measurement],
                _HELD_OUT[held_out],
                f"{first.printer_numbers} + {first.measurement_numbers}",
                with_interval(first.mae_nm, first.mae_ci95_nm),
                f"{one['full'].mae_nm:.2f} nm",
            ]
        )
    return markdown_table(
        [
            "model",
            "what is added to the predicted print",
            "held out",
            "parameters (printer + measurement)",
            "error at k = 1",
            "error at k = 7",
        ],
        rows,
        f"Mean absolute error over all valid pixels of {len(result.errors[0].by_scan_nm)} scans. Only "
        "k terms are fitted to a scored scan, on pixels that are not scored. Brackets contain 95 % "
        "intervals from resampling scans.",
    )


def causes_table(result: CloseLoop) -> str:
    """Return the table of the effects that the loop added, with their strengths."""
    return markdown_table(
        [
            "effect",
            "groups of scans",
            "strengths (95 % interval from the scatter between prints)",
            "change of error without it",
            "scans improved",
            "looks like",
            "also found with base",
        ],
        [
            [
                f"`{one.name}`{' (described)' if one.knowledge == 'description' else ''}",
                one.by,
                "<br>".join(_sizes(one)),
                f"{one.left_out_nm:+.2f} nm",
                "{} of {}".format(*one.scans_improved),
                ", ".join(one.confusable_with) or "–",
                ", ".join(one.survives_on) or "–",
            ]
            for one in result.effects
            if one.name not in TABLES
        ],
    )


def _sizes(one: FoundEffect) -> list[str]:
    found = []
    for name, strengths in one.strengths.items():
        for own in strengths:
            unit = "" if own.unit == "1" else f" {own.unit}"
            label = f" ({own.label})" if own.label else ""
            ends = "" if own.ci95 is None else f" ({own.ci95[0]:.3f} … {own.ci95[1]:.3f})"
            found.append(f"{name}{label}: {own.value:.3f}{unit}{ends}")
    return found


def picture(result: CloseLoop) -> Figure:
    """Draw the error of each scan before and after the loop."""
    rows: list[tuple[str, ErrorRow | None]] = [
        ("base, published protocol", result.error("base", "offset", "published")),
        ("base with the measurement model", result.error("base")),
        ("with all findings", result.error("all")),
        ("with all findings, whole prints held out", result.error("all", held_out="prints")),
    ]
    shown = [(label, row) for label, row in rows if row is not None]
    figure = new_figure(9, 0.7 * len(shown) + 1)
    axes = figure.subplots()
    for at, (_, row) in enumerate(shown):
        values = [*row.by_scan_nm.values()]
        axes.plot(values, np.full(len(values), at), "o", ms=5, alpha=0.45, color="#2f7fd0")
        axes.plot(row.mae_nm, at, "|", ms=26, mew=3, color="#12344d")
        axes.annotate(f"{row.mae_nm:.2f}", (row.mae_nm, at), (0, 14), textcoords="offset points", ha="center")
    axes.set_yticks(range(len(shown)), [label for label, _ in shown])
    axes.invert_yaxis()
    axes.margins(y=0.25)
    axes.set_xlabel("mean absolute error of each held-out scan, offset fitted (nm)")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def main() -> None:
    """Copy the record, draw the picture, and write the tables into the page."""
    parser = options(__doc__)
    parser.add_argument("run", type=Path, help="folder that `litho-models close-loop` has written")
    run = parser.parse_args().run
    FOLDER.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(run / CloseLoop.FILE_NAME, FOLDER / CloseLoop.FILE_NAME)
    result = CloseLoop.read(FOLDER)
    picture(result).savefig(FOLDER / PICTURE, dpi=110)
    for name, text in texts(result).items():
        publish(PAGE, name, text)


if __name__ == "__main__":
    run_script(main)
