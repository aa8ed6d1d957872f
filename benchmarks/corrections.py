"""Measure whether `litho-design correct` makes prints match their target reliefs. The judges are independent
of the models that make the corrections.

    python -m benchmarks.corrections --out runs/corrections [--publish]

The judges are three virtual fabs and PBL, a model of the measured prints from the zoo. Each prints five
reliefs. The fabs have the effects of benchmarks.gap, which none of the models contains. Each correction is
made with three models that have different formulas. For a fab, these models are trained on scans of its
prints. For PBL, they are models of the zoo.

Each correction is compared with two simple layouts: the nominal heights, and the best affine layout, whose
heights are the nominal ones times a gain plus an offset. Gain and offset are chosen once by the models that
make the correction, and once by the judge. The choice of the judge could not be made before printing. An
interrupted run continues when it is run again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.gap.plan import PRINT_KNOBS, SCAN_KNOBS
from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, kept, options, origin, place_for
from litho_data import build_dataset, simulate
from litho_data.commands.progress import run_script
from litho_design import Task, correct, load_design
from litho_design.printers.printer import Printer
from litho_design.printers.source import load_printer
from litho_design.reliefs.settings import ReliefSettings, relief_settings
from litho_design.reliefs.targets import load_relief
from litho_design.reliefs.task import ReliefTask
from litho_models import freeze, train

PAGE = Path(__file__).parents[1] / "docs" / "optics.md"
RESULT = PAGE.parent / "results" / "corrections" / "corrections.json"
NAME = "corrections"
RELIEFS = ("cap", "freeform", "blaze", "staircase", "lens")
# The seeds of the fabs were announced before any of these fabs printed anything.
SEEDS = (75, 76, 77)
FAB_MODELS = ("physics", "blur-table", "linear")
ZOO_MODELS, ZOO_JUDGE = tuple(f"zoo:{name}" for name in FAB_MODELS), "zoo:pbl"
SCANS, SCAN_PX, SIZE_PX, POLISH = 6, 128, 128, 40
COLUMNS = {
    "uncorrected": "nominal heights",
    "best affine": "best affine, chosen by the models",
    "affine by the judge": "best affine, chosen by the judge",
    "corrected": "corrected",
}
# A correction counts as worse if its error exceeds that of the better simple layout by more than this factor.
ALLOWED = 1.05


def main() -> None:
    """Make the corrections that have no result yet, write the record, and print the table."""
    given = _arguments()
    torch.set_num_threads(1)
    settings = relief_settings({"layout.size_px": given.size, "search.polish_rounds": POLISH})
    rows = []
    for seed, models, judge in _printers(given.out, settings):
        for relief in RELIEFS:
            place = place_for(given.out / f"{judge.name}-{seed}", relief, size_px=given.size)
            make = partial(corrected, relief, seed, models, judge, place, settings)
            rows.append(kept(place.with_suffix(".json"), make))
    record = {
        "schema": "litho-design/benchmark-corrections/1",
        "size_px": given.size,
        **origin(),
        "rows": rows,
    }
    out = RESULT if given.publish else given.out / f"{NAME}.json"
    conclude(record, as_markdown(record), out, PAGE, NAME, published=given.publish)


def corrected(
    relief: str, seed: int, models: Sequence[Printer], judge: Printer, out: Path, settings: ReliefSettings
) -> dict[str, Any]:
    """Make one correction, and return its record, with the rms errors in nm of the prints of all layouts in
    ``COLUMNS``.
    """
    wanted = wanted_um(relief, seed, settings)
    made = correct(wanted, models[0], out, settings=settings, judges=models[1:], announce=False)
    inputs = {"relief_um": wanted}
    layouts = _Plain(settings, models[0], inputs=inputs, ensemble=models[1:]).untouched()
    judging = _Plain(settings, judge, inputs=inputs)
    layouts["affine by the judge"] = judging.untouched()["best affine"]
    layouts["corrected"] = load_design(out).level
    assert made.width is not None
    return {
        "relief": relief,
        "seed": seed,
        "judge": judge.name,
        "returned": made.width.returned,
        "stated_nm": made.predicted["rms_nm"],
        "between_nm": list(made.width.between),
        "printed_nm": {name: _rms_nm(judging, layouts[name]) for name in COLUMNS},
    }


def wanted_um(name: str, seed: int, settings: ReliefSettings) -> np.ndarray:
    """Return the heights of a relief in µm, as an array of shape (size, size). The freeform surface is drawn
    with the seed.
    """
    layout, high_um = settings.layout, settings.height_um
    if name in ("cap", "blaze", "staircase"):
        return load_relief("lens" if name == "cap" else name, layout, high_um)[0]
    place = (np.arange(layout.size_px) + 0.5) / layout.size_px - 0.5
    y, x = np.meshgrid(place, place, indexing="ij")
    if name == "lens":
        # Four zones of a Fresnel lens.
        surface = -16 * (x**2 + y**2) % 1
    else:
        order, draw = np.arange(4), np.random.default_rng(seed)
        size = draw.normal(size=(4, 4)) / (1 + order[:, None] ** 2 + order**2)
        turn = draw.uniform(0, 2 * np.pi, (4, 4))
        y, x = y[..., None, None], x[..., None, None]
        waves = np.cos(2 * np.pi * (order[:, None] * y + order * x) + turn)
        surface = (size * waves).sum((-2, -1))
        surface = (surface - surface.min()) / np.ptp(surface)
    return (high_um * surface).astype(np.float32)


def as_markdown(record: Mapping[str, Any]) -> str:
    """Return the summary, and a table with one row per relief and printer. Each entry is the range over the
    seeds.
    """
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in record["rows"]:
        groups.setdefault((row["relief"], row["judge"]), []).append(row)
    lines = [
        (relief, judge, *(_span([row["printed_nm"][name] for row in rows]) for name in COLUMNS))
        for (relief, judge), rows in groups.items()
    ]
    heads = ("relief", "printed by", *COLUMNS.values())
    note = (
        "The cells contain the rms error of the print in nm, after its mean error is subtracted. For the "
        "fabs, they contain the smallest and the largest error of the three fabs. The reliefs are 0.6 µm "
        f"high and {record['size_px']} px wide."
    )
    return f"{summary(record['rows'])}\n\n{markdown_table(heads, lines, note)}"


def _span(values: Sequence[float]) -> str:
    low, high = (f"{end(values):.0f}" for end in (min, max))
    return low if low == high else f"{low} to {high}"


def summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a text that says how the corrections compare with the simple layouts, and how often the error of
    a print lies in the range that the correction stated.
    """
    worse = [row for row in rows if over_idle(row) > ALLOWED]
    inside = [row for row in rows if holds(row)]
    blazes = [over_idle(row, ("best affine",)) for row in rows if row["relief"] == "blaze"]
    listed = [f"{row['relief']} by {row['judge']} {row['seed']} {over_idle(row):.2f} ×" for row in worse]
    named = f" ({', '.join(listed)})" if listed else ""
    median = np.median([over_idle(row) for row in rows])
    return (
        "Each corrected layout is compared with the better of two others, the layout of nominal heights and "
        f"the affine layout chosen by the models. In {len(worse)} of {len(rows)} cases, the error of the "
        f"corrected print is more than 5 % larger{named}. The median ratio of the errors is {median:.2f}. "
        f"For blazes, the median ratio to the error of this affine layout is {np.median(blazes):.2f}. "
        f"The errors of {len(inside)} of {len(rows)} prints lie in the range that the correction stated."
    )


def holds(row: Mapping[str, Any]) -> bool:
    """Return whether the error of the print lies in the range that the correction stated."""
    low, high = row["between_nm"]
    return bool(low <= row["printed_nm"]["corrected"] <= high)


def over_idle(row: Mapping[str, Any], idle: Sequence[str] = ("uncorrected", "best affine")) -> float:
    """Return the error of the corrected print divided by that of the best print of the layouts in
    ``idle``.
    """
    printed = row["printed_nm"]
    return float(printed["corrected"] / min(printed[name] for name in idle))


def _printers(out: Path, settings: ReliefSettings) -> Iterator[tuple[int, list[Printer], Printer]]:
    """Yield, for each printer, its seed, the models that make corrections for it, and the printer itself as
    judge. Fabs and models that do not exist yet are made first.
    """
    for seed in SEEDS:
        folder = out / f"fab-{seed}"
        store = folder / "prints.zarr"
        if not store.exists():
            knobs = [f"{name}={value}" for name, value in (PRINT_KNOBS | SCAN_KNOBS).items()]
            build_dataset(
                simulate(folder / "fab", count=SCANS, size_px=SCAN_PX, seed=seed, knobs=knobs), store
            )
        for name in FAB_MODELS:
            if not (folder / name / "card.json").exists():
                train(store, name, folder / f"run-{name}")
                freeze(folder / f"run-{name}", folder / name)
        models = [load_printer(folder / name, settings.layout) for name in FAB_MODELS]
        yield seed, models, load_printer(folder / "fab" / "truth", settings.layout, name="fab")
    models = [load_printer(source, settings.layout) for source in ZOO_MODELS]
    yield 0, models, load_printer(ZOO_JUDGE, settings.layout)


class _Plain(ReliefTask):
    """The task with which the best affine layouts are found. Its loss ignores the errors of the models on
    their training prints.
    """

    loss_by = Task.loss_by


@torch.no_grad()
def _rms_nm(task: ReliefTask, level: torch.Tensor) -> float:
    return task.figures(task.printed_um(level))["rms_nm"]


def _arguments() -> argparse.Namespace:
    parser = options(__doc__, "write the record and the table into the documentation")
    parser.add_argument("--out", type=Path, required=True, help="folder of the fabs, models and designs")
    parser.add_argument("--size", type=int, default=SIZE_PX, help="side of the reliefs in pixels")
    return parser.parse_args()


if __name__ == "__main__":
    run_script(main)
