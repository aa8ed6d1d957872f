"""Levelling speed on one 540 x 540 scan, beside the time of Gwyddion's C library where it is known.

    OMP_NUM_THREADS=1 python benchmarks/levelling.py --out FOLDER [--scan FILE --unit m]

Prints one table and writes `levelling.json` and `levelling.csv`. Best and median of many runs.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from litho_data.files import atomic_file
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
from litho_data.level.facet import facet_pass
from litho_data.readers import read_scan
from litho_data.results import software_versions

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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for levelling.json and levelling.csv")
    parser.add_argument("--scan", type=Path, help="a 540 x 540 scan; by default an artificial one")
    parser.add_argument("--unit", help="unit of its heights where the file states none")
    parser.add_argument("--repeats", type=int, default=50)
    arguments = parser.parse_args()
    height_um = (
        artificial_scan()
        if arguments.scan is None
        else read_scan(arguments.scan, unit=arguments.unit).height_um
    )
    table = measure(height_um, arguments.repeats)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.2f}", na_rep=""))
    arguments.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(arguments.out / "levelling.csv", index=False)
    record = {
        "schema": "litho-data/benchmark-levelling/1",
        "shape": list(height_um.shape),
        "scan": "artificial" if arguments.scan is None else arguments.scan.name,
        "machine": platform.processor() or platform.machine(),
        "threads": os.environ.get("OMP_NUM_THREADS", "as many as there are cores"),
        "versions": software_versions(),
        "rows": json.loads(table.to_json(orient="records")),
    }
    with atomic_file(arguments.out / "levelling.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def artificial_scan() -> np.ndarray:
    """Blobs of a micrometre on a tilt, with row offsets and pixel noise, µm."""
    from scipy import ndimage

    rng = np.random.default_rng(0)
    blobs = ndimage.gaussian_filter(rng.normal(size=SHAPE), 12)
    rows = 0.008 * rng.normal(size=(SHAPE[0], 1))
    tilt = 0.0005 * np.arange(SHAPE[1])[None, :]
    return 0.5 + 0.15 * blobs / blobs.std() + rows + tilt + 0.004 * rng.normal(size=SHAPE)


def measure(height_um: np.ndarray, repeats: int) -> pd.DataFrame:
    """One row per method: best and median time in ms, Gwyddion's, and the ratio of the best to it."""
    # One large free makes the C allocator keep its pages, as in any process that has read a few scans.
    np.ones(1 << 22).sum()
    rows = []
    for name, run in cases(height_um).items():
        run()
        times_ms = np.array([timed_ms(run) for _ in range(repeats)])
        gwyddion_ms = GWYDDION_MS.get(name, np.nan)
        best_ms = float(times_ms.min())
        rows.append(
            {
                "method": name,
                "best_ms": best_ms,
                "median_ms": float(np.median(times_ms)),
                "gwyddion_ms": gwyddion_ms,
                "best_to_gwyddion": best_ms / gwyddion_ms,
                "goal_met": "" if np.isnan(gwyddion_ms) else "yes" if best_ms <= GOAL * gwyddion_ms else "no",
            }
        )
    return pd.DataFrame(rows)


def cases(z: np.ndarray) -> dict[str, Callable[[], object]]:
    """The methods, ready to run."""
    mask = z > np.quantile(z, 0.8)
    layout = np.clip(np.round(z / z.max() * 12), 0, 12)
    slope_x, slope_y = (np.diff(z, axis=axis)[:539, :539].ravel() / 0.1 for axis in (1, 0))
    scars = mark_scars(align_rows(z, method="median").height)
    methods = {
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
            f"rows: {name}": lambda method=method: align_rows(z, method=method, pitch_um=PITCH_UM)
            for name, method in methods.items()
        },
        "rows: median, masked": lambda: align_rows(z, method="median", mask=mask),
        "robust plane": lambda: level_robust(z),
        "mask and relevel": lambda: mask_and_relevel(z),
        "layout-aware plane": lambda: level_layout_aware(z, layout_level=layout),
        "mark scars": lambda: mark_scars(z),
        "remove scars": lambda: remove_scars(z, scars=scars),
    }


def timed_ms(run: Callable[[], object]) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    run()
    return (time.perf_counter() - start) * 1e3


if __name__ == "__main__":
    main()
