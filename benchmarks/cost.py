"""What 10,000 scans and elements of 1, 10 and 30 mm cost: from published measurements, and bounds for GPUs.

    python -m benchmarks.cost

Nothing is measured: the models of the cost are those of docs/results/large, the time of a scan is that of
docs/results/build/cluster.json. A bound for GPUs is what their data sheet allows for the sums of the areawise
network, in float32 over all neighbours, and for what an iteration has to move and to send. The tables go into
docs/cost.md.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.large import moved_gb
from benchmarks.record import publish
from benchmarks.trained_pbl import areawise_gflop
from litho_data.foundation.commands import run_script
from litho_design.large.cost import CostModel, memory_in_use_gib, sent_gib
from litho_models.models.pbl import PblConfig

_DOCS = Path(__file__).parents[1] / "docs"
PAGE = _DOCS / "cost.md"
SCANS = 10_000
SIDES_PX = (10_000, 100_000, 300_000)
# arXiv:2505.22313; a square of as many points.
FAR_END_PX = math.isqrt(128_640 * 85_760)
# A band is printed once for the wave, and again for the gradient, which costs as much as a print.
_PRINTS_PER_ITERATION = 3


class Gpu(NamedTuple):
    """Of the data sheet of an H100 SXM: float32 without TF32, memory, its rate, and the link to others."""

    gflops: float = 67e3
    memory_gb: float = 80.0
    gb_per_s: float = 3350.0
    sent_gb_per_s: float = 450.0


def main() -> None:
    """Compute, print, put into the page."""
    for name, table in tables().items():
        print(table, end="\n\n")
        publish(PAGE, name, table)


def tables() -> dict[str, str]:
    """The tables of the page, by name, from the published results."""
    results = _DOCS / "results"
    cluster = json.loads((results / "build" / "cluster.json").read_text(encoding="utf-8"))
    models = {
        name: CostModel.model_validate(json.loads((results / "large" / f"{name}.json").read_text())["fit"])
        for name in ("physics", "pbl")
    }
    return {
        "scans": of_scans(cluster),
        "elements": of_elements(models),
        "gpus": of_gpus(Gpu(), PblConfig()),
    }


def of_scans(record: Mapping[str, Any]) -> str:
    """Time and memory of so many scans, in proportion to those that were built."""
    times = SCANS / record["scans"]
    rows = [
        f"| {run['way']} | {time_of(times * run['wall_s'])} | {time_of(times * run['worker_cpu_s'])} "
        f"| {max(run['worker_mib'].values()):.0f} MiB |"
        for run in record["runs"]
        if not run["killed"]
    ]
    return "\n".join(
        [
            f"| {SCANS:,} scans of {record['size_px']} px | time | of the workers' processors "
            f"| memory of a worker after {record['scans']:,} |",
            "|---|---|---|---|",
            *rows,
        ]
    )


def of_elements(models: Mapping[str, CostModel]) -> str:
    """An iteration on one core and on two, by the models of the cost."""
    rows = []
    for size in (*SIDES_PX, FAR_END_PX):
        times = [time_of(model.iteration_s(size, ranks)) for model in models.values() for ranks in (1, 2)]
        memory = models["pbl"].memory_of_rank_gib(size)
        rows.append(
            f"| {_side(size)} | {' | '.join(times)} | {memory_of(memory)} | {memory_of(sent_gib(size, 2))} |"
        )
    head = "| element | Physics, one core | two | PBL, one core | two | memory | sent by each of two |"
    return "\n".join([head, "|---" * 7 + "|", *rows])


def of_gpus(gpu: Gpu, pbl: PblConfig) -> str:
    """Least time of an iteration through PBL on one GPU and on eight, and how many would hold the element."""
    rows = []
    for size in (*SIDES_PX, FAR_END_PX):
        times = [time_of(least_s(size, count, gpu, pbl)) for count in (1, 8)]
        held = [memory_in_use_gib(size, count) * 2**30 / 1e9 for count in (1, 8)]
        fits = [bytes_gb <= gpu.memory_gb for bytes_gb in held]
        shown = [time if fit else f"({time})" for time, fit in zip(times, fits, strict=True)]
        needed = math.ceil(8 * held[1] / gpu.memory_gb)
        rows.append(
            f"| {_side(size)} | {' | '.join(shown)} | {1 if fits[0] else needed:,} "
            f"| {memory_of(sent_gib(size, 8))} |"
        )
    head = "| element | one GPU, at least | eight, at least | GPUs that hold it | sent by each of eight |"
    return "\n".join([head, "|---" * 5 + "|", *rows])


def least_s(size_px: int, count: int, gpu: Gpu, pbl: PblConfig) -> float:
    """Of an iteration: its sums, what its transforms move, and what they send."""
    sums = _PRINTS_PER_ITERATION * areawise_gflop(pbl, size_px**2) / gpu.gflops
    sent = sent_gib(size_px, count) * 2**30 / 1e9 / gpu.sent_gb_per_s
    return (sums + moved_gb(size_px) / gpu.gb_per_s) / count + sent


def time_of(seconds: float) -> str:
    """Two digits, in the unit that suits."""
    units: Sequence[tuple[float, str]] = ((86_400, "days"), (3600, "h"), (60, "min"), (1, "s"))
    factor, unit = next((one for one in units if seconds >= 1.5 * one[0]), (1, "s"))
    return f"{float(f'{seconds / factor:.2g}'):g} {unit}"


def memory_of(gib: float) -> str:
    """Two digits, in GiB or TiB."""
    value, unit = (gib / 1024, "TiB") if gib >= 512 else (gib, "GiB")
    return f"{float(f'{value:.2g}'):g} {unit}"


def _side(size_px: int) -> str:
    if size_px == FAR_END_PX:
        return "128,640 × 85,760 points"
    return f"{size_px:,} px ({size_px / 10_000:.3g} mm)"


if __name__ == "__main__":
    run_script(main)
