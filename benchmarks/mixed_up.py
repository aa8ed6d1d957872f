"""Are mixed-up files named at the build? Sets of virtual prints, sound and with one mistake each.

    python -m benchmarks.mixed_up [--store STORE.zarr] [--publish]

Every set is built twice: as the fab delivers it, where nothing may be named, and after a mistake, where all
that it touches and nothing else has to be. --store asks the same of measured prints, taken as sound.
--publish also writes the table into docs/own_data.md.
"""

from __future__ import annotations

import contextlib
import csv
import io
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin
from litho_data.build.build import build_dataset
from litho_data.build.right_layout import doubts, prints_of
from litho_data.foundation.commands import progress, run_script
from litho_data.layouts import random_layout
from litho_data.store import open_store
from litho_data.virtual_fab import simulate
from litho_data.virtual_fab.printer import Job

PAGE = Path(__file__).parents[1] / "docs" / "own_data.md"
RESULT = PAGE.parent / "results" / "mixed-up" / "mixed_up.json"
NAME = "mixed_up.json"
SEED = 30500
SIZE_PX = 128
DOSES = (0.9, 1.0, 1.1)
_LAYOUTS = 2
# What is done to a set, how often, and the words that name it.
Mistake = Callable[[Path, np.random.Generator], list[str]]


def main() -> None:
    """Measure, print, write."""
    parser = options(__doc__, "write the table into docs/own_data.md", RESULT)
    parser.add_argument("--store", type=Path, help="measured prints, by litho-data build")
    arguments = parser.parse_args()
    cases = [kind for kind, (count, *_) in MISTAKES.items() for _ in range(count)]
    record = {
        "schema": "litho-data/benchmark-mixed-up/1",
        "seed": SEED,
        "size_px": SIZE_PX,
        **origin(),
        "cases": [measure(kind, SEED + n) for n, kind in enumerate(progress(cases, "mixed-up sets"))],
        "measured": None if arguments.store is None else of_store(arguments.store),
    }
    conclude(record, as_markdown(record), arguments.out, PAGE, NAME, published=arguments.publish)


def measure(kind: str, seed: int) -> dict[str, Any]:
    """Print a set, build it, make the mistake, build again; ids that were named each time."""
    _, words, mistake = MISTAKES[kind]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        card = simulate(folder / "fab", jobs=_jobs(seed), seed=seed)
        sound = _named(card, folder / "prints.zarr")
        touched = mistake(card.parent, np.random.default_rng(seed))
        named = _named(card, folder / "prints.zarr")
    return {
        "kind": kind,
        "seed": seed,
        "prints": len(DOSES) * _LAYOUTS,
        "touched": touched,
        "named": sorted(name for name in touched if words in named.get(name, "")),
        "false": sorted(set(named) - set(touched)),
        "false_before": sorted(sound),
        "said": named,
    }


def of_store(path: Path) -> dict[str, Any]:
    """What is said of the scans of a store."""
    store = open_store(path)
    scans = {scan.id: scan for scan in store.scans()}
    dihedral = dict(zip(store.quality["scan"], store.quality["dihedral"], strict=True))
    records = [
        {
            "id": name,
            "print": scan.print_id,
            "columns": {"dose": scan.dose, "turned_deg": scan.turned_deg},
            "quality": {"dihedral": dihedral[name]},
        }
        for name, scan in scans.items()
    ]
    said = doubts(prints_of(records, lambda name: vars(scans[name])))
    return {"dataset_sha256": store.sha256, "scans": len(scans), "said": said}


def _jobs(seed: int) -> list[Job]:
    """A few layouts, each printed at every dose; one print block a dose."""
    rng = np.random.default_rng(seed)
    layouts = [random_layout((SIZE_PX, SIZE_PX), cutoff_per_um=0.5, seed=rng) for _ in range(_LAYOUTS)]
    return [
        Job(id=f"P{block}F{field}", level=level, index=_LAYOUTS * (block - 1) + field - 1, dose=dose)
        for block, dose in enumerate(DOSES, start=1)
        for field, level in enumerate(layouts, start=1)
    ]


def _named(card: Path, store: Path) -> dict[str, str]:
    """Build, and read what is said to be checked, by id."""
    told = io.StringIO()
    with contextlib.redirect_stderr(told):
        build_dataset(card, store)
    lines = [
        line.removeprefix("check ") for line in told.getvalue().splitlines() if line.startswith("check ")
    ]
    return {name: text for name, _, text in (line.partition(": ") for line in lines)}


def _two(rng: np.random.Generator, count: int) -> list[int]:
    return sorted((1 + rng.choice(count, 2, replace=False)).tolist())


def _swap_dose_blocks(raw: Path, rng: np.random.Generator) -> list[str]:
    """Two blocks trade their doses in the table."""
    one, other = _two(rng, len(DOSES))
    table = raw / "scans.csv"
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    block = {row["id"]: int(row["id"][1]) for row in rows}
    dose = {block[row["id"]]: row["dose"] for row in rows}
    trade = {one: dose[other], other: dose[one]}
    for row in rows:
        row["dose"] = trade.get(block[row["id"]], row["dose"])
    with table.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return sorted(name for name, number in block.items() if number in trade)


def _mirror_layout(raw: Path, rng: np.random.Generator) -> list[str]:
    """One layout's file is turned over: left to right, top to bottom, or along a diagonal."""
    name = f"P{rng.integers(1, len(DOSES) + 1)}F{rng.integers(1, _LAYOUTS + 1)}"
    file = raw / "layouts" / f"{name}.tif"
    level = tifffile.imread(file)
    turned = (level[:, ::-1], level[::-1], level.T)[rng.integers(3)]
    tifffile.imwrite(file, np.ascontiguousarray(turned))
    return [name]


def _swap_ids(raw: Path, rng: np.random.Generator) -> list[str]:
    """The scans of two layouts trade their ids, whatever their doses."""
    blocks = rng.integers(1, len(DOSES) + 1, 2)
    names = [f"P{block}F{field}" for block, field in zip(blocks, _two(rng, _LAYOUTS), strict=True)]
    first, second = (raw / "scans" / f"{name}.txt" for name in names)
    held = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(held)
    return sorted(names)


MISTAKES: dict[str, tuple[int, str, Mistake]] = {
    "dose blocks swapped": (7, "are these two swapped", _swap_dose_blocks),
    "layout mirrored": (6, "mirror image", _mirror_layout),
    "scans under each other's id": (7, "it shows the layout of", _swap_ids),
}


def as_markdown(record: Mapping[str, Any]) -> str:
    """Cases that were named, and what was named without cause."""
    rows = []
    for kind in MISTAKES:
        cases = [case for case in record["cases"] if case["kind"] == kind]
        named = sum(case["named"] == case["touched"] for case in cases)
        false, before = (sum(len(case[key]) for case in cases) for key in ("false", "false_before"))
        prints = sum(case["prints"] for case in cases)
        touched = sum(len(case["touched"]) for case in cases)
        rows.append((kind, f"{named} of {len(cases)}", str(touched), f"{false} of {prints - touched}",
                     f"{before} of {prints}"))  # fmt: skip
    heads = ("mistake", "named in", "scans it touches", "others named", "named before it was made")
    note = (
        f"Sets of {record['cases'][0]['prints']} virtual prints, {_LAYOUTS} layouts of {record['size_px']} "
        f"px at {len(DOSES)} doses ({', '.join(map(str, DOSES))}), seeds from {record['seed']}. Named: all "
        "scans that the mistake touches, each with its cause."
    )
    if record["measured"]:
        measured = record["measured"]
        note += f" Of the {measured['scans']} measured prints {len(measured['said']) or 'none'} is named."
    return markdown_table(heads, rows, note)


if __name__ == "__main__":
    run_script(main)
