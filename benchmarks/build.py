"""Time and memory of `litho-data build`, every build in a fresh process.

    python -m benchmarks.build --out FILE.json [--scans 1000] [--workers 2] [--publish]
    python -m benchmarks.build --against CHECKOUT [--publish]

First the measured prints (LITHO_DATA_DIR says where they are), then many virtual scans. These come from a
cheap generator, not from the virtual fab: blurred random layouts with white noise, as .npy files. Making them
is not part of what is measured. With --against only the measured prints are built, in turns by the code that
is here and by that of another checkout. --publish also writes the table into docs/dataset_store.md.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.record import conclude, options, origin, usable_cores
from litho_data.foundation.commands import run_script
from litho_data.foundation.run_facts import checkout_state
from litho_data.layouts import random_layout
from litho_data.layouts.card_text import write_layout

HERE = Path(__file__).parents[1]
PAGE = HERE / "docs" / "dataset_store.md"
RESULT = PAGE.parent / "results" / "build" / "build.json"
NAME = "build.json"
IN_TURNS = "build_in_turns.json"
MEASURED_CARD = HERE / "datasets" / "neural-lithography.toml"
GOAL_WALL_S, GOAL_PEAK_MIB = 25.0, 1536.0
_MARGIN_PX = 14
_SAMPLED_EVERY_S = 0.05


class Cost(NamedTuple):
    """Of one process with all it started. ``peak_mib`` adds resident sets, shared pages each time anew."""

    wall_s: float
    cpu_s: float
    peak_mib: float


def main() -> None:
    """Measure, print, write."""
    parser = options(__doc__, "write the table into docs/dataset_store.md")
    parser.add_argument("--out", type=Path, help="JSON file to write; default: that of the page")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="compare with its code, in turns")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--repeats", type=int, default=3, help="builds of the measured prints; 0 leaves them out"
    )
    parser.add_argument("--scans", type=int, default=1000, help="virtual scans; 0 leaves them out")
    parser.add_argument("--size", type=int, default=512, help="side of their layouts, pixels")
    parser.add_argument("--scratch", type=Path, help="folder for scans and stores; 6 MB per virtual scan")
    arguments = parser.parse_args()
    if arguments.scratch:
        Path(arguments.scratch).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=arguments.scratch) as scratch:
        folder = Path(scratch)
        runs = []
        trees = [HERE, *([] if arguments.against is None else [arguments.against.resolve()])]
        if arguments.repeats:
            runs += measure(
                "measured prints", MEASURED_CARD, folder, arguments.workers, arguments.repeats, trees
            )
        if arguments.scans and arguments.against is None:
            card = write_virtual_scans(folder / "virtual", arguments.scans, arguments.size)
            runs += measure("virtual scans", card, folder, arguments.workers, repeats=1)
    record = {
        "schema": "litho-data/benchmark-build/1",
        "machine": {"cores": usable_cores()},
        **origin(),
        "goal": {"wall_s": GOAL_WALL_S, "peak_mib": GOAL_PEAK_MIB},
        "generator": "blurred random layouts with white noise, .npy",
        "runs": runs,
    }
    if arguments.against is None:
        text, name = as_markdown(record), NAME
    else:
        text, name = compared(record), IN_TURNS
    out = arguments.out or RESULT.with_name(name)
    conclude(record, text, out, PAGE, name, published=arguments.publish)


def compared(record: Mapping[str, Any]) -> str:
    """The builds of two checkouts, and what the first takes of the second."""
    here, other = record["runs"]
    rows = [
        f"| {run['commit'][:7]} | {sum(run['wall_s']) / len(run['wall_s']):.1f} | {min(run['wall_s']):.1f} "
        f"| {sum(run['cpu_s']) / len(run['cpu_s']):.1f} | {max(run['peak_mib']):.0f} |"
        for run in (other, here)
    ]
    wall, cpu = (sum(here[key]) / sum(other[key]) for key in ("wall_s", "cpu_s"))
    return (
        f"{here['scans']} measured prints, {here['workers']} workers on {record['machine']['cores']} cores, "
        f"{len(here['wall_s'])} builds of each in turns: the second commit takes {wall:.2f} × the wall time "
        f"and {cpu:.2f} × the processor time of the first.\n\n"
        "| commit | wall, mean, s | wall, best, s | processor time, mean, s | peak memory, MiB |\n"
        "|---|---|---|---|---|\n" + "\n".join(rows)
    )


def as_markdown(record: Mapping[str, Any]) -> str:
    """The measurement as a table, with what it was measured on."""
    rows = [
        f"| {run['scans']} {run['what']} | {run['workers']} | {min(run['wall_s']):.1f} "
        f"| {max(run['wall_s']):.1f} | {max(run['cpu_s']):.1f} | {max(run['peak_mib']):.0f} |"
        for run in record["runs"]
    ]
    return (
        f"{record['machine']['cores']} cores. Virtual scans: {record['generator']}.\n\n"
        "| build of | workers | wall, best, s | wall, worst, s | processor time, s | peak memory, MiB |\n"
        "|---|---|---|---|---|---|\n" + "\n".join(rows)
    )


def measure(
    what: str, card: Path, folder: Path, workers: int, repeats: int, trees: Sequence[Path] = (HERE,)
) -> list[dict[str, Any]]:
    """Build a card ``repeats`` times by the code of each checkout in turn: one record per checkout.

    Every build goes into a store of its own and is a process of its own.
    """
    costs: list[list[Cost]] = [[] for _ in trees]
    results: list[dict[str, Any]] = [{} for _ in trees]
    for _ in range(repeats):
        for k, tree in enumerate(trees):
            with tempfile.TemporaryDirectory(dir=folder) as scratch:
                store = Path(scratch) / "prints.zarr"
                command = [Path(sys.executable).with_name("litho-data"), "build", card, "--out", store]
                costs[k].append(cost_of([*map(str, command), "--workers", str(workers)], tree))
                report = Path(scratch) / "prints-report" / "build.json"
                results[k] = json.loads(report.read_text(encoding="utf-8"))
    return [
        {
            "what": what,
            "commit": checkout_state(tree)["commit"],
            "scans": result["n_scans"],
            "skipped": len(result["skipped"]),
            "workers": workers,
            **{name: [round(getattr(cost, name), 2) for cost in spent] for name in Cost._fields},
            "dataset_sha256": result["dataset"]["sha256"],
        }
        for tree, spent, result in zip(trees, costs, results, strict=True)
    ]


def cost_of(command: list[str], tree: Path = HERE) -> Cost:
    """Run a command by the code of a checkout and watch it and all its descendants.

    Raises:
        CalledProcessError: it fails.
    """
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | {"PYTHONPATH": str(tree)})
    peak_bytes, ended = 0, 0
    try:
        while not ended:
            peak_bytes = max(peak_bytes, sum(resident_bytes(pid) for pid in _with_descendants(process.pid)))
            time.sleep(_SAMPLED_EVERY_S)
            ended, status, usage = os.wait4(process.pid, os.WNOHANG)
    finally:
        if not ended:
            process.kill()
    wall_s = time.perf_counter() - started
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return Cost(wall_s, usage.ru_utime + usage.ru_stime, peak_bytes / 2**20)


def write_virtual_scans(folder: Path, count: int, size_px: int) -> Path:
    """Layouts and scans of ``size_px`` with a margin; returns the card."""
    from scipy.ndimage import gaussian_filter

    (folder / "scans").mkdir(parents=True)
    for index in range(count):
        rng = np.random.default_rng(index)
        layout = random_layout((size_px, size_px), cutoff_per_um=0.5, seed=rng)
        write_layout(folder, f"V{index:05}", layout)
        height_um = gaussian_filter(np.pad(0.08 * layout.astype(np.float32), _MARGIN_PX, mode="edge"), 3.0)
        height_um += rng.normal(0, 0.01, height_um.shape).astype(np.float32)
        np.save(folder / "scans" / f"V{index:05}.npy", height_um)
    side_um = (size_px + 2 * _MARGIN_PX) * 0.1
    text = (
        'name = "virtual-scans"\n[layout]\nfiles = "layouts/{id}.tif"\npitch_um = 0.1\n'
        "level_height_um = 0.1\nlevels = 13\n"
        '[scan]\nfiles = "scans/{id}.npy"\nformat = "npy"\nunit = "um"\nlevelled = true\n'
        f"size_um = [{side_um}, {side_um}]\n"
    )
    card = folder / "card.toml"
    card.write_text(text, encoding="utf-8")
    return card


def _with_descendants(pid: int) -> list[int]:
    """Linux: the process and all that it started, as far as they live."""
    found = [pid]
    for parent in found:
        try:
            threads = list(Path(f"/proc/{parent}/task").iterdir())
            children = [child for thread in threads for child in (thread / "children").read_text().split()]
        except OSError:
            continue
        found += [int(child) for child in children]
    return found


def resident_bytes(pid: int) -> int:
    """Linux: the resident set of a process; 0 where it is gone."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0


if __name__ == "__main__":
    run_script(main)
