"""Does the uncertainty in the store cover the errors of its heights? Virtual prints know their surface.

    python -m benchmarks.height_sigma [--count 20] [--publish]

Prints are simulated, scanned and built as any other; the error of a pixel is its stored height minus the true
surface, roughness included, minus the mean of that over the scan. --publish also writes the table into
docs/dataset_store.md.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin
from litho_data.build.build import build_dataset
from litho_data.foundation.commands import run_script
from litho_data.store import open_store
from litho_data.virtual_fab.simulate import simulate

PAGE = Path(__file__).parents[1] / "docs" / "dataset_store.md"
RESULT = PAGE.parent / "results" / "height-sigma" / "height_sigma.json"
NAME = "height_sigma.json"
SEED = 20441
COVERED = {"within_68": 1.0, "within_95": 1.96}
_LEVEL = '\n[process]\nlevel = "recipe.toml"\n'
_RECIPE = '[[step]]\nop = "plane"\n'
# Side of the fields, px; what is added to the fab's default noise (pixels 0.75, lines 0.6 nm, roughness
# 15.9 nm); the recipe; and how many times as many scans as asked for. A tilt and bow is one draw a scan.
# Even with its size known exactly, 20 scans have 69.6 ± 1.1 % of their pixels within 1 σ, one set in nine
# more than 71 %.
CONDITIONS: Mapping[str, tuple[int, tuple[str, ...], str, int]] = {
    "default noise": (512, (), "", 1),
    "lines of 8 nm": (512, ("scan-line-stripes=8",), "", 1),
    "tilt and bow of 20 nm": (512, ("tilt-bow=20",), "", 3),
    "tilt and bow, plane taken out": (512, ("tilt-bow=20",), _RECIPE, 3),
    "256 px": (256, (), "", 1),
    "256 px, tilt and bow of 20 nm": (256, ("tilt-bow=20",), "", 3),
    "256 px, plane taken out": (256, ("tilt-bow=20",), _RECIPE, 3),
}


def main() -> None:
    """Measure, print, write."""
    parser = options(__doc__, "write the table into docs/dataset_store.md", RESULT)
    parser.add_argument(
        "--count", type=int, default=20, help="scans of each condition, three times as many with a surface"
    )
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    record = {
        "schema": "litho-data/benchmark-height-sigma/1",
        "seed": SEED,
        "count": arguments.count,
        **origin(),
        "conditions": [
            {"what": what, **measure(knobs, recipe, times * arguments.count, size_px, arguments.workers)}
            for what, (size_px, knobs, recipe, times) in CONDITIONS.items()
        ],
    }
    conclude(record, as_markdown(record), arguments.out, PAGE, NAME, published=arguments.publish)


def measure(
    knobs: tuple[str, ...], recipe: str, count: int, size_px: int, workers: int = 1, seed: int = SEED
) -> dict[str, Any]:
    """Simulate, build, and compare errors with their uncertainty; nm where it says so."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        card = simulate(folder / "fab", count=count, size_px=size_px, seed=seed, knobs=knobs)
        if recipe:
            card.with_name("recipe.toml").write_text(recipe, encoding="utf-8")
            card.write_text(card.read_text(encoding="utf-8") + _LEVEL, encoding="utf-8")
        build_dataset(card, folder / "prints.zarr", workers=workers)
        store = open_store(folder / "prints.zarr")
        ratios, errors_nm = [], []
        for scan in store.scans():
            surface_um = np.load(folder / "fab" / "truth" / "surfaces" / f"{scan.id}.npy")
            assert scan.height_sigma_um is not None
            error_um = (scan.height_um - surface_um)[scan.valid].astype(np.float64)
            error_um -= error_um.mean()
            ratios.append(error_um / scan.height_sigma_um[scan.valid])
            errors_nm.append(1e3 * float(error_um.std()))
        budget = {name: store.quality[name] for name in map(str, store.quality) if name.startswith("sigma_")}
    pooled, each = np.concatenate(ratios), [float(one.std()) for one in ratios]
    return {
        "scans": len(ratios),
        "pixels": int(pooled.size),
        "error_nm": float(np.sqrt(np.mean(np.square(errors_nm)))),
        "budget_nm": {name: float(np.sqrt((values**2).mean())) for name, values in budget.items()},
        "sd": float(np.sqrt((pooled**2).mean())),
        **{name: float((np.abs(pooled) < limit).mean()) for name, limit in COVERED.items()},
        "sd_of_scans": [round(one, 3) for one in each],
    }


def as_markdown(record: Mapping[str, Any]) -> str:
    """The measurement as a table, with what it was measured on."""
    rows = []
    for one in record["conditions"]:
        parts = {
            name.removeprefix("sigma_").removesuffix("_nm"): value
            for name, value in one["budget_nm"].items()
            if name != "sigma_nm" and value >= 0.05
        }
        rows.append(
            (
                one["what"],
                str(one["scans"]),
                f"{one['error_nm']:.1f}",
                f"{one['budget_nm']['sigma_nm']:.1f}",
                ", ".join(f"{name} {value:.1f}" for name, value in parts.items()),
                f"{one['sd']:.2f}",
                f"{100 * one['within_68']:.1f}, {100 * one['within_95']:.1f} %",
                f"{min(one['sd_of_scans']):.2f}–{max(one['sd_of_scans']):.2f}",
            )
        )
    heads = (
        "virtual prints",
        "scans",
        "error, nm",
        "σ, nm",
        "of which",
        "sd of error / σ",
        "within 1, 1.96 σ",
        "sd of a scan",
    )
    note = (
        f"Fields of 512 px if nothing else is said, seed {record['seed']}; all pixels of all scans "
        "pooled; last column: smallest and largest of one scan."
    )
    return markdown_table(heads, rows, note)


if __name__ == "__main__":
    run_script(main)
