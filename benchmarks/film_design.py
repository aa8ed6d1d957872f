"""Correct the layout of a film with a model of the second machine, and judge the correction with other
models.

    python -m benchmarks.film_design prefab-soi.zarr [--publish]

The target is the layout of a locked pattern, on which no model was trained. The layout is corrected with the
model `e-beam`. The judges `blur-table` and `random-features` were trained on the same micrographs as
`e-beam`, but have different formulas.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin, place_for
from benchmarks.second_machine import PAGE, judged
from benchmarks.second_machine import RESULT as MACHINE
from litho_data.commands.progress import run_script
from litho_data.reports.pictures import new_figure
from litho_data.store import open_store
from litho_design import correct, load_design
from litho_design.printers.printer import Printer
from litho_design.printers.source import load_printer
from litho_design.reliefs.settings import ReliefSettings, relief_settings
from litho_models import freeze, train

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from litho_data.store import PrintedScan

RESULT = MACHINE.with_name("film_design.json")
PATTERN, SIZE_PX, POLISH = "random_lpass_0.13_1", 256, 20
DESIGNER, JUDGES = "e-beam", ("blur-table", "random-features")
# Width, in px, of the rim that is not scored. It is left out because the prediction assumes that nothing is
# written outside the design.
RIM_PX = 24
PICTURE = """![Corrected layout; target film and edges of both prints](results/second-machine/design.png)

*Left: the corrected layout (grey means a partial dose). Middle and right: the target film, and the edges that
`blur-table` predicts for the uncorrected and for the corrected layout.*"""


def main() -> None:
    """Train the models, correct the layout, judge both layouts, write the record, and print the table."""
    parser = options(__doc__, "write the table and the picture into the documentation", RESULT)
    parser.add_argument("store", type=Path, help="dataset store of the second machine")
    parser.add_argument(
        "--cache", type=Path, default=Path("runs/film-design"), help="folder of the models and the design"
    )
    given = parser.parse_args()
    torch.set_num_threads(1)
    store = open_store(given.store)
    scan, cache = store.scan(PATTERN), place_for(given.cache, store.name, dataset=store.sha256)
    settings = settings_for(scan)
    film = wanted_film(scan)
    printers = {name: printer(name, given.store, cache, settings) for name in (DESIGNER, *JUDGES)}
    out = cache / "design"
    if not (out / "design.json").is_file():
        correct(film.height_um, printers[DESIGNER], out, settings=settings, robust=False, announce=False)
    layouts = {
        "uncorrected": film.height_um,
        "corrected": load_design(out).level.numpy() * np.float32(scan.level_height_um),
    }
    prints = {
        (name, kind): printed(one, layout, settings)
        for name, one in printers.items()
        for kind, layout in layouts.items()
    }
    record = {
        "run": origin(),
        "pattern": PATTERN,
        "size_px": SIZE_PX,
        "pitch_um": scan.pitch_um,
        "rows": [
            {"model": name, "layout": kind, **judged(film, one)} for (name, kind), one in prints.items()
        ],
    }
    if given.publish:
        by_judge = {kind: prints[JUDGES[0], kind] for kind in layouts}
        figure = drawn(film.height_um, layouts["corrected"], by_judge)
        figure.savefig(given.out.with_name("design.png"), dpi=110)
    conclude(record, text_of(record), given.out, PAGE, "film design", published=given.publish)


def settings_for(scan: PrintedScan, size_px: int = SIZE_PX) -> ReliefSettings:
    """Return the settings of a design with the pitch and the levels of a scan."""
    geometry = {"pitch_um": scan.pitch_um, "cell_um": scan.pitch_um, "levels": scan.levels}
    geometry |= {"size_px": size_px, "level_height_um": scan.level_height_um}
    changes = {f"layout.{name}": value for name, value in geometry.items()}
    return relief_settings({**changes, "search.polish_rounds": POLISH})


def wanted_film(scan: PrintedScan, size_px: int = SIZE_PX) -> PrintedScan:
    """Return the square in the middle of a scan's layout as the target film. Its rim is marked as not valid,
    so that it is not scored.
    """
    top, left = ((length - size_px) // 2 for length in scan.shape)
    level = scan.mask_level[top : top + size_px, left : left + size_px]
    inner = np.pad(np.ones([size_px - 2 * RIM_PX] * 2, bool), RIM_PX)
    film = replace(scan, mask_level=level, valid=inner, height_sigma_um=None)
    return replace(film, height_um=film.layout_um)


def printer(name: str, store: Path, cache: Path, settings: ReliefSettings) -> Printer:
    """Return a printer with a model that was trained on the store. The model is trained and frozen if it does
    not exist yet.
    """
    folder = cache / name
    if not (folder / "printer" / "card.json").is_file():
        train(store, name, folder / "run")
        freeze(folder / "run", folder / "printer")
    return load_printer(folder / "printer", settings.layout)


@torch.no_grad()
def printed(by: Printer, layout_um: np.ndarray, settings: ReliefSettings) -> np.ndarray:
    """Return the heights that a printer's model predicts for a layout. Both are arrays of shape (ny, nx) in
    µm.
    """
    levels = torch.from_numpy(layout_um / np.float32(settings.layout.level_height_um))
    return by(levels[None, None])[0, 0].numpy()


def text_of(record: Mapping[str, Any]) -> str:
    """Return the picture, and a table with a row for each model and layout, in Markdown."""
    heads = (
        "predicted by",
        "layout",
        "mean edge error",
        "95th percentile of the edge error",
        "area error",
        "missing",
        "extra",
        "merged",
    )
    rows = [
        (
            *(row[key] for key in ("model", "layout")),
            *(f"{row[key]:.2f} nm" for key in ("edge_mean_nm", "edge_p95_nm")),
            f"{row['area_error_percent']:.2f} %",
            *(str(row[key]) for key in ("missing", "extra", "merged")),
        )
        for row in record["rows"]
    ]
    return f"{PICTURE}\n\n{markdown_table(heads, rows)}"


def drawn(wanted_um: np.ndarray, layout_um: np.ndarray, prints: Mapping[str, np.ndarray]) -> Figure:
    """Draw the corrected layout, and the target film with the edges of both predicted prints."""
    figure = new_figure(10, 3.6)
    first, *others = figure.subplots(1, 3)
    cut = (slice(RIM_PX, -RIM_PX),) * 2
    first.imshow(layout_um[cut], cmap="Greys_r")
    first.set_title("corrected layout", fontsize=9)
    for axes, (kind, height_um) in zip(others, prints.items(), strict=True):
        axes.imshow(wanted_um[cut], cmap="Greys_r", alpha=0.5)
        axes.contour(height_um[cut], [wanted_um.max() / 2], colors=["#c23b22"], linewidths=1.3)
        axes.set_title(f"target film, edges of the {kind} print", fontsize=9)
    for axes in (first, *others):
        axes.set_axis_off()
    return figure


if __name__ == "__main__":
    run_script(main)
