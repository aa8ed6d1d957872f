"""Levelling speed on one 540 x 540 scan, beside the time of Gwyddion's C library where it is known.

    OMP_NUM_THREADS=1 python -m benchmarks.levelling --out FILE.json [--scan FILE --unit m] [--publish]

Best and median of many runs of each method. --publish also writes the table into docs/levelling.md.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import conclude, options, origin, usable_cores
from litho_data.foundation.commands import run_script
from litho_data.level import (
    align_rows,
    level_facet,
    level_layout_aware,
    level_plane,
    level_polynomial,
    level_robust,
    mark_scars,
    mask_and_relevel,
    remove_scars,
)
from litho_data.level.plane import facet_pass
from litho_data.level.rows import RowMethod
from litho_data.readers import read_scan

PAGE = Path(__file__).parents[1] / "docs" / "levelling.md"
RESULT = PAGE.parent / "results" / "levelling" / "levelling.json"
NAME = "levelling.json"
SHAPE = (540, 540)
PITCH_UM = (0.1, 0.1)
# Gwyddion 2.62's C functions on a field of this size, ms, on the machine class of this project.
GWYDDION_MS = {
    "plane": 0.35,
    "facet, one pass": 1.7,
    "polynomial 2, 2": 11.7,
    "rows: median": 0.6,
    "rows: trimmed mean of differences": 2.7,
}
GOAL = 3.0


def main() -> None:
    """Measure, print, write."""
    parser = options(__doc__, "write the table into docs/levelling.md", RESULT)
    parser.add_argument("--scan", type=Path, help="a 540 x 540 scan; by default an artificial one")
    parser.add_argument("--unit", help="unit of its heights where the file states none")
    parser.add_argument("--repeats", type=int, default=50)
    arguments = parser.parse_args()
    height_um = (
        artificial_scan()
        if arguments.scan is None
        else read_scan(arguments.scan, unit=arguments.unit).height_um
    )
    record = {
        "schema": "litho-data/benchmark-levelling/1",
        "scan": "artificial" if arguments.scan is None else arguments.scan.name,
        "shape": list(height_um.shape),
        "repeats": arguments.repeats,
        "machine": {"cores": usable_cores()},
        "threads": os.environ.get("OMP_NUM_THREADS", "as many as there are cores"),
        **origin(),
        "goal": GOAL,
        "methods": measure(height_um, arguments.repeats),
    }
    conclude(record, as_markdown(record), arguments.out, PAGE, NAME, published=arguments.publish)


def as_markdown(record: Mapping[str, Any]) -> str:
    """The measurement as a table, with what it was measured on."""
    ny, nx = record["shape"]
    rows = [
        f"| {row['method']} | {row['best_ms']:.2f} | {row['median_ms']:.2f} "
        + ("| | |" if row["gwyddion_ms"] is None else f"| {row['gwyddion_ms']:g} | {row['ratio']:.2f} |")
        for row in record["methods"]
    ]
    return (
        f"One {ny} × {nx} scan ({record['scan']}), {record['machine']['cores']} cores, threads: "
        f"{record['threads']}, best and median of {record['repeats']} runs, numpy "
        f"{record['versions']['numpy']}.\n\n"
        "| method | best, ms | median, ms | Gwyddion, ms | best / Gwyddion |\n|---|---|---|---|---|\n"
        + "\n".join(rows)
    )


def artificial_scan() -> np.ndarray:
    """Blobs of a micrometre on a tilt, with row offsets and pixel noise, µm."""
    from scipy import ndimage

    rng = np.random.default_rng(0)
    blobs = ndimage.gaussian_filter(rng.normal(size=SHAPE), 12)
    rows = 0.008 * rng.normal(size=(SHAPE[0], 1))
    tilt = 0.0005 * np.arange(SHAPE[1])[None, :]
    return 0.5 + 0.15 * blobs / blobs.std() + rows + tilt + 0.004 * rng.normal(size=SHAPE)


def measure(height_um: np.ndarray, repeats: int) -> list[dict[str, Any]]:
    """One row per method: best and median time in ms, Gwyddion's, and the ratio of the best to it."""
    # One large free makes the C allocator keep its pages, as in any process that has read a few scans.
    np.ones(1 << 22).sum()
    rows = []
    for name, run in cases(height_um).items():
        run()
        times_ms = [timed_ms(run) for _ in range(repeats)]
        best_ms, gwyddion_ms = min(times_ms), GWYDDION_MS.get(name)
        rows.append(
            {
                "method": name,
                "best_ms": round(best_ms, 4),
                "median_ms": round(float(np.median(times_ms)), 4),
                "gwyddion_ms": gwyddion_ms,
                "ratio": None if gwyddion_ms is None else round(best_ms / gwyddion_ms, 4),
            }
        )
    return rows


def cases(z: np.ndarray) -> dict[str, Callable[[], object]]:
    """The methods, ready to run."""
    mask = z > np.quantile(z, 0.8)
    layout = np.clip(np.round(z / z.max() * 12), 0, 12)
    slope_x, slope_y = (np.diff(z, axis=axis)[:539, :539].ravel() / 0.1 for axis in (1, 0))
    scars = mark_scars(align_rows(z, method="median").height)
    methods: dict[str, RowMethod] = {
        "median": "median",
        "median of differences": "median-of-differences",
        "trimmed mean": "trimmed-mean",
        "trimmed mean of differences": "trimmed-mean-of-differences",
        "polynomial 1": "polynomial",
        "matching": "matching",
        "modus": "modus",
        "facet tilt": "facet-tilt",
    }
    return {
        "plane": lambda: level_plane(z),
        "plane, masked": lambda: level_plane(z, mask=mask),
        "facet, one pass": lambda: facet_pass(slope_x, slope_y),
        "facet, whole": lambda: level_facet(z, pitch_um=PITCH_UM),
        "polynomial 2, 2": lambda: level_polynomial(z, x_degree=2, y_degree=2),
        "polynomial 2, 2, masked": lambda: level_polynomial(z, x_degree=2, y_degree=2, mask=mask),
        **{
            f"rows: {name}": partial(align_rows, z, method=method, pitch_um=PITCH_UM)
            for name, method in methods.items()
        },
        "rows: median, masked": lambda: align_rows(z, method="median", mask=mask),
        "robust plane": lambda: level_robust(z),
        "mask and relevel": lambda: mask_and_relevel(z),
        "layout-aware plane": lambda: level_layout_aware(z, layout_level=layout, blur_px=3.0),
        "mark scars": lambda: mark_scars(z),
        "remove scars": lambda: remove_scars(z, scars=scars),
    }


def timed_ms(run: Callable[[], object]) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    run()
    return (time.perf_counter() - start) * 1e3


if __name__ == "__main__":
    run_script(main)
