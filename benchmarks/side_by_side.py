"""Several implementations of one task, each in a process of its own, timed in turns.

A process per side keeps their peak memories apart. All are started and warmed up first, then each
does one repeat after the other, so that a slow minute of the machine hits them alike. On a GPU ours also runs
on the processors beside it, in the same turns.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.record import conclude, options, origin, usable_cores
from litho_design.optimisation.budget import peak_memory_gib
from litho_design.printers.source import check_device
from litho_models.frozen import zoo
from litho_models.models.pbl import Pbl, PblConfig

PAGE = Path(__file__).parents[1] / "docs" / "speed.md"
RESULTS = PAGE.parent / "results" / "speed"
SCHEMA = "litho-models/benchmark-speed/1"
PLAIN = "plain"
# Beside a GPU: ours on the processors of the same machine.
ON_CPU = "float32, CPU"
# Gradients in another precision than heights are for CPUs.
_CPU_ONLY = ("mixed",)
# Side of the matrices whose product shows the highest rate.
_MATRIX = {"cpu": 2048, "cuda": 8192}
_PRODUCTS, _ENOUGH_S = 12, 10.0

Arrays = Mapping[str, np.ndarray]
Work = tuple[Callable[[], object], Callable[[], Arrays]]


@dataclass(frozen=True)
class Comparison:
    """One task, done by several sides.

    Attributes:
        name: of the record and of its place in the page.
        sides: their names, the plain one among them.
        size_px: of the field, unless it is given.
        work: of a side: a function that does the task once, and one that returns what it made.
        limit_gflop: of a side and a size: convolutions of one task per dtype, GFLOP, without margins.
        differences: figures of what a side made, given what the plain one made and the receptive radius.
    """

    name: str
    sides: Sequence[str]
    size_px: int
    work: Callable[[str, argparse.Namespace], Work]
    limit_gflop: Callable[[PblConfig, str, int], Mapping[str, float]]
    differences: Callable[[Arrays, Arrays, int], Mapping[str, float]]


def parser(description: str | None, tasks: Iterable[str]) -> argparse.ArgumentParser:
    """The options of a comparison."""
    found = options(description, "write the table into docs/speed.md")
    found.add_argument("task", choices=list(tasks))
    found.add_argument("--out", type=Path, help="JSON file to write")
    found.add_argument("--model", type=Path, default=zoo.folder("pbl"), help="frozen PBL; default: the zoo's")
    found.add_argument("--size-px", type=int)
    found.add_argument("--repeats", type=int, default=7)
    found.add_argument("--threads", type=int, default=usable_cores())
    found.add_argument("--device", default="cpu", help="cpu, or a GPU: cuda")
    found.add_argument("--side", help=argparse.SUPPRESS)
    found.add_argument("--arrays", type=Path, help=argparse.SUPPRESS)
    return found


def run(module: str, task: Comparison, pbl: Pbl, arguments: argparse.Namespace) -> None:
    """Measure all sides, print, write, publish; or do the work of one side in this process.

    Args:
        module: what ``python -m`` runs.
        pbl: the network that is compared.
        arguments: of ``parser``.
    """
    name, sides = task.name, task.sides
    arguments.size_px = arguments.size_px or task.size_px
    torch.set_num_threads(arguments.threads)
    check_device(arguments.device)
    device = torch.device(arguments.device)
    if arguments.side:
        _serve(*task.work(arguments.side, arguments), arguments.arrays, device)
        return
    peaks = _peaks_gflops(device)
    cpu_peaks = _peaks_gflops(torch.device("cpu"))
    if device.type == "cuda":
        name = f"{name}_gpu"
        sides = [side for side in sides if side not in _CPU_ONLY] + [ON_CPU]
    with tempfile.TemporaryDirectory() as folder:
        measured = _in_turns(module, arguments, sides, Path(folder))
        made = {side: dict(np.load(_arrays_file(Path(folder), side))) for side in sides}
    plain = measured[PLAIN]
    rows = []
    for side, row in measured.items():
        on_cpu = side == ON_CPU
        work_gflop = task.limit_gflop(pbl.config, "float32" if on_cpu else side, arguments.size_px)
        rates = cpu_peaks if on_cpu else peaks
        rows.append(
            {
                "side": side,
                **row,
                "faster": plain["median_s"] / row["median_s"],
                "memory": row["peak_gib"] / plain["peak_gib"],
                "gflop": sum(work_gflop.values()),
                "limit_s": sum(gflop / rates[dtype] for dtype, gflop in work_gflop.items()),
                **task.differences(made[side], made[PLAIN], pbl.reach_px),
            }
        )
    record = {
        "schema": SCHEMA,
        "size_px": arguments.size_px,
        "repeats": arguments.repeats,
        "machine": {
            "cores": usable_cores(),
            "bfloat16_matrix_unit": _has_matrix_unit(),
            **({"gpu": torch.cuda.get_device_name(device)} if device.type == "cuda" else {}),
        },
        "threads": arguments.threads,
        **origin(),
        "peak_gflops": peaks,
        **({"cpu_peak_gflops": cpu_peaks} if device.type == "cuda" else {}),
        "sides": rows,
    }
    out = arguments.out or RESULTS / f"{name}.json"
    conclude(record, as_markdown(record), out, PAGE, name, published=arguments.publish)


def as_markdown(record: Mapping[str, Any]) -> str:
    """The measurement as a table, with what it was measured on."""
    extra = [key for key in record["sides"][0] if key.endswith(("_nm", "_percent"))]
    heads = ["", "median, s", "best, s", "faster", "peak, GiB", "of plain", "limit, s", "of limit"]
    heads += [_head(key) for key in extra]
    rows = []
    for row in record["sides"]:
        cells = [
            row["side"],
            f"{row['median_s']:.3f}",
            f"{row['best_s']:.3f}",
            f"{row['faster']:.1f} ×",
            f"{row['peak_gib']:.2f}",
            f"{row['memory']:.2f}",
            f"{row['limit_s']:.3f}",
            f"{100 * row['limit_s'] / row['best_s']:.0f} %",
            *(f"{row[key]:.3g}" for key in extra),
        ]
        rows.append("| " + " | ".join(cells) + " |")
    unit = "with" if record["machine"]["bfloat16_matrix_unit"] else "without"
    gpu = record["machine"].get("gpu")
    side_px = _MATRIX["cuda" if gpu else "cpu"]
    rates = f"Matrix products of {side_px}² reach {_rates(record['peak_gflops'])} GFLOP/s"
    if gpu:
        rates += (
            f" on the GPU, in float32 with factors rounded to TF32 as its convolutions do; "
            f"{_rates(record['cpu_peak_gflops'])} on the CPU"
        )
    return (
        f"{record['size_px']} × {record['size_px']} px, {f'{gpu} beside ' if gpu else ''}{record['threads']} "
        f"threads on {record['machine']['cores']} cores {unit} a bfloat16 matrix unit, {record['repeats']} "
        f"repeats, torch {record['versions']['torch']}. {rates}.\n\n"
        f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}\n" + "\n".join(rows)
    )


def peak_gflops(dtype: torch.dtype, device: torch.device) -> float:
    """Best rate of a large matrix product on the threads in use or on a GPU, GFLOP/s."""
    size = _MATRIX[device.type]
    square = torch.randn(size, size, device=device).to(dtype)
    seconds: list[float] = []
    # One product of a dtype for which the processor has no unit can take minutes.
    while len(seconds) < _PRODUCTS and sum(seconds) < _ENOUGH_S:
        started = _now(device)
        square @ square
        seconds.append(_now(device) - started)
    return 2 * size**3 / min(seconds) / 1e9


def relative_percent(difference: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square of a difference in percent of that of a reference."""
    return 100 * float(
        np.sqrt(np.mean(difference.astype(float) ** 2) / np.mean(reference.astype(float) ** 2))
    )


def _peaks_gflops(device: torch.device) -> dict[str, float]:
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32
    try:
        return {
            str(dtype).split(".")[-1]: peak_gflops(dtype, device) for dtype in (torch.float32, torch.bfloat16)
        }
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before


def _now(device: torch.device) -> float:
    """Seconds of the clock, once the device has done what was asked of it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _rates(peaks: Mapping[str, float]) -> str:
    return ", ".join(f"{value:,.0f} in {dtype}" for dtype, value in peaks.items())


def _in_turns(
    module: str, arguments: argparse.Namespace, sides: Sequence[str], folder: Path
) -> dict[str, dict[str, float]]:
    workers = {side: _start(module, arguments, side, folder) for side in sides}
    seconds: dict[str, list[float]] = {side: [] for side in sides}
    try:
        for turn in range(arguments.repeats + 1):
            for side, worker in workers.items():
                elapsed = float(_answer(worker, "repeat"))
                # The first one warms up.
                seconds[side] += [elapsed] if turn else []
        peaks = {side: float(_answer(worker, "end")) for side, worker in workers.items()}
    finally:
        for worker in workers.values():
            worker.kill()
            worker.wait()
    return {
        side: {
            "best_s": min(seconds[side]),
            "median_s": statistics.median(seconds[side]),
            "peak_gib": peaks[side],
        }
        for side in sides
    }


def _start(module: str, arguments: argparse.Namespace, side: str, folder: Path) -> subprocess.Popen[str]:
    device = "cpu" if side == ON_CPU else arguments.device
    does = "float32" if side == ON_CPU else side
    command = [sys.executable, "-m", module, arguments.task, "--side", does, "--device", device]
    command += ["--arrays", str(_arrays_file(folder, side))]
    for option in ("model", "size_px", "threads"):
        command += [f"--{option.replace('_', '-')}", str(getattr(arguments, option))]
    return subprocess.Popen(
        command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=PAGE.parents[1]
    )


def _answer(worker: subprocess.Popen[str], request: str) -> str:
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write(request + "\n")
    worker.stdin.flush()
    answer = worker.stdout.readline()
    if not answer:
        raise SystemExit(f"one side ended early: {worker.args!r}")
    return answer


def _serve(
    once: Callable[[], object], made: Callable[[], Arrays], arrays: Path, device: torch.device
) -> None:
    """Answer requests for one repeat each with its seconds; at the end with the peak memory, GiB."""
    for request in sys.stdin:
        if request.strip() == "end":
            peak_gib = peak_memory_gib(device)
            np.savez(arrays, allow_pickle=False, **made())
            print(json.dumps(peak_gib), flush=True)
            return
        started = _now(device)
        once()
        print(json.dumps(_now(device) - started), flush=True)


def _arrays_file(folder: Path, side: str) -> Path:
    return folder / f"{side.replace(', ', '_')}.npz"


def _has_matrix_unit() -> bool:
    return bool(torch.cpu.get_capabilities().get("amx_bf16"))


def _head(key: str) -> str:
    words, _, unit = key.rpartition("_")
    return f"{words.replace('_', ' ')}, {'nm' if unit == 'nm' else '%'}"
