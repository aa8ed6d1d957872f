"""Are the STL files of twenty random holograms of 1,024 px closed, and how large are they?

    python -m benchmarks.stl_files --out runs/stl.json [--designs 20] [--publish]

Every design has a target of its own (blots at random) and a random start, and is searched with the default
settings but for forty steps in place of 300: through the zoo's physics model, and for a perfect printer. Each
file is read by trimesh and numpy-stl, which know nothing of the writer (``pip install trimesh numpy-stl``).
Beside it stands the least that any exact closed surface of these levels takes, by a count of its corners.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin
from litho_data.foundation.commands import run_script
from litho_data.foundation.errors import InputError
from litho_design import hologram_settings, load_printer
from litho_design.exports.stl import write_stl
from litho_design.holograms.settings import HologramSettings
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import load_target
from litho_design.optimisation.search import search_layout
from litho_design.printers.printer import Printer

PAGE = Path(__file__).parents[1] / "docs" / "optics.md"
RESULT = PAGE.parent / "results" / "stl" / "stl.json"
NAME = "stl.json"
FIRST_SEED = 500
STEPS, START_STEPS = 40, 10
LIMIT_MB = 15.0
PEDESTAL_UM = 1.0
PRINTERS = {"zoo:physics": "designed through `zoo:physics`", "none": "designed for a perfect printer"}
RANDOM = "independent random levels"
_TRIANGLE_BYTES, _HEAD_BYTES = 50, 84


def main() -> None:
    """Design, write, read, print, write the record."""
    parser = options(__doc__, "write record and table into docs", Path("runs/stl.json"))
    parser.add_argument("--designs", type=int, default=20, help="of each printer")
    parser.add_argument("--size", type=int, default=1024, help="side of the elements, pixels")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = hologram_settings(
        changes={
            "layout.size_px": arguments.size,
            "optics.distance_um": 300 * arguments.size / 1024,
            "search.iterations": STEPS,
            "search.start_iterations": START_STEPS,
        }
    )
    seeds = range(FIRST_SEED, FIRST_SEED + arguments.designs)
    rows = []
    for source in (*PRINTERS, RANDOM):
        printer = load_printer(source, settings.layout) if source in PRINTERS else None
        for seed in seeds if printer else seeds[:3]:
            levels = designed(settings, printer, seed) if printer else random_levels(settings, seed)
            rows.append({"levels": source, "seed": seed, **measured(levels, settings)})
            print(rows[-1], flush=True)
    record = {
        "schema": "litho-design/benchmark-stl/1",
        "size_px": arguments.size,
        "cell_px": settings.layout.cell_px,
        **origin(),
        "rows": rows,
    }
    out = RESULT if arguments.publish else arguments.out
    out.parent.mkdir(parents=True, exist_ok=True)
    conclude(record, as_markdown(record), out, PAGE, NAME, published=arguments.publish)


def designed(settings: HologramSettings, printer: Printer, seed: int) -> np.ndarray:
    """Levels (cells, cells) of a hologram of blots drawn at random, whose start is random as well."""
    size = settings.layout.size_px
    blots = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((size, size)), (0, 0), size / 50)
    target = load_target((blots > blots.std()).astype(np.float32), size)
    search = settings.search.model_copy(update={"seed": seed})
    task = HologramTask(settings.model_copy(update={"search": search}), printer, target)
    found = search_layout(task.free_parameters(), task.objective, search).best_levels
    assert found is not None
    return found.numpy().astype(np.uint8)


def random_levels(settings: HologramSettings, seed: int) -> np.ndarray:
    """The roughest layout that there is: no cell knows of its neighbours."""
    cells = settings.layout.size_px // settings.layout.cell_px
    return np.random.default_rng(seed).integers(0, settings.layout.levels, (cells, cells)).astype(np.uint8)


def measured(levels: np.ndarray, settings: HologramSettings) -> dict[str, Any]:
    """Size of the file, what it takes at least, and whether two parsers of others find it closed."""
    layout = settings.layout
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hologram.stl"
        write_stl(file, levels, layout.cell_um, layout.level_height_um, PEDESTAL_UM)
        volume_um3 = float((PEDESTAL_UM + layout.level_height_um * levels).sum()) * layout.cell_um**2
        return {
            "megabytes": file.stat().st_size / 1e6,
            "least_megabytes": (_HEAD_BYTES + _TRIANGLE_BYTES * (2 * corners(levels) - 4)) / 1e6,
            **_read_by_others(file, volume_um3),
        }


def corners(levels: np.ndarray) -> int:
    """Corners of the solid that has one column per cell, the four below with them.

    A corner is a height of a grid point at which the solid changes along x, along y and along z: where a
    column ends, unless either halves of the four, split along x or along y, are the same above and below.
    """
    cells = np.pad(levels.astype(int), 1, constant_values=-1)
    around = np.stack([cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]])
    found = 0
    for height in range(-1, int(levels.max()) + 1):
        here = (around == height).any(0)
        below, above = around >= height, around > height
        flat = np.zeros(here.shape, bool)
        for a, b, c, d in ((0, 1, 2, 3), (0, 2, 1, 3)):
            flat |= np.logical_and.reduce([(one[a] == one[b]) & (one[c] == one[d]) for one in (below, above)])
        found += int((here & ~flat).sum())
    return found


def _read_by_others(file: Path, volume_um3: float) -> dict[str, Any]:
    try:
        import stl
        import trimesh
    except ImportError as error:
        raise InputError("parsers", got=f"no {error.name}", wanted="pip install trimesh numpy-stl") from None
    whole = trimesh.load(file)
    mesh = stl.Mesh.from_file(str(file))
    return {
        "triangles": len(whole.faces),
        "trimesh_closed": bool(whole.is_watertight and whole.is_winding_consistent),
        "trimesh_euler": int(whole.euler_number),
        "trimesh_volume_off": abs(float(whole.volume) / volume_um3 - 1),
        "numpy_stl_closed": bool(mesh.is_closed(exact=True)),
        "numpy_stl_triangles": len(mesh.vectors),
    }


def closed(row: Mapping[str, Any]) -> bool:
    """Whether both parsers find one closed, consistently wound sheet of the same triangles."""
    return bool(
        row["trimesh_closed"]
        and row["numpy_stl_closed"]
        and row["trimesh_euler"] == 2
        and row["triangles"] == row["numpy_stl_triangles"]
    )


def as_markdown(record: Mapping[str, Any]) -> str:
    """One line per kind of layout."""
    lines = []
    for kind in (*PRINTERS, RANDOM):
        rows = [row for row in record["rows"] if row["levels"] == kind]
        least, file = (
            f"{min(found):.1f} … {max(found):.1f}"
            for found in ([row[name] for row in rows] for name in ("least_megabytes", "megabytes"))
        )
        small = sum(row["megabytes"] <= LIMIT_MB for row in rows)
        lines.append(
            (PRINTERS.get(kind, kind), least, file, f"{small} of {len(rows)}",
             f"{sum(map(closed, rows))} of {len(rows)}")
        )  # fmt: skip
    heads = ("levels", "at least, MB", "file, MB", f"{LIMIT_MB:g} MB or less", "closed, by both parsers")
    return markdown_table(heads, lines)


if __name__ == "__main__":
    run_script(main)
