"""Hologram iterations in bands at growing sizes, and how well a model of their cost meets a size left out.

    python -m benchmarks.large [--model zoo:pbl] [--sizes 1024 2048] [--left-out 4096] [--publish]

One process. On a processor one thread and its own seconds: the machine may do other work. With ``--device
cuda`` seconds of the clock, and beside the transforms what moving their numbers takes at the rate of a large
copy. The model is fitted to the largest of ``--sizes`` and compared with ``--left-out``, which is measured
last. Memory is the peak so far, of the process or of the GPU. ``--publish`` puts the table into
docs/large.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from benchmarks.record import conclude, origin
from litho_data.foundation.commands import run_script
from litho_design.holograms.settings import hologram_settings
from litho_design.large.cost import fit_cost, measure_size
from litho_design.optics.sampling import fast_length
from litho_design.printers.source import load_printer

_DOCS = Path(__file__).parents[1] / "docs"


def main() -> None:
    """Measure, fit, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="zoo:pbl")
    parser.add_argument("--band-px", type=int, default=512)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1024, 2048])
    parser.add_argument("--left-out", type=int, default=4096)
    parser.add_argument("--device", default="cpu", help="cpu, or a GPU: cuda")
    parser.add_argument("--out", type=Path, help="JSON file; docs/results/large/MODEL.json by default")
    parser.add_argument("--publish", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    settings = hologram_settings()
    printer = load_printer(given.model, settings.layout, device=given.device)
    on_gpu = printer.device.type == "cuda"
    clock = _clock_of_gpu if on_gpu else time.process_time
    measured = []
    for size in [*given.sizes, given.left_out]:
        measured.append(measure_size(settings, printer, size, given.band_px, clock))
        print(measured[-1], flush=True)
    *fitted, left_out = measured
    model = fit_cost(fitted)
    predicted = {
        "iteration_s": model.iteration_s(given.left_out),
        "evaluation_s": model.evaluation_s(given.left_out),
        "peak_memory_gib": model.memory_of_rank_gib(given.left_out),
    }
    error = {name: value / getattr(left_out, name) - 1 for name, value in predicted.items()}
    content = {
        "schema": "litho-design/large-cost/2",
        **origin(),
        "model": given.model,
        "band_px": given.band_px,
        **(_of_gpu(printer.device) if on_gpu else {}),
        "measured": [one.model_dump() for one in measured],
        "fit": model.model_dump(),
        "predicted": predicted,
        "error": error,
    }
    name = f"{printer.name}-gpu" if on_gpu else printer.name
    out = given.out or _DOCS / "results" / "large" / f"{name}.json"
    conclude(
        content,
        as_markdown(content),
        out,
        _DOCS / "large.md",
        f"large-{name}",
        published=given.publish,
    )


def as_markdown(record: Mapping[str, Any]) -> str:
    """The table of the page, of a record."""
    rate = record.get("copy_gb_per_s")
    rows = [
        f"| {one['size_px']:,} | {one['iteration_s']:.2f} s | {one['transforms_s']:.2f} s "
        + (f"| {moved_gb(one['size_px']) / rate:.4f} s " if rate else "")
        + f"| {one['evaluation_s']:.2f} s | {one['peak_memory_gib']:.2f} GiB |"
        for one in record["measured"]
    ]
    time_s, evaluation, memory = (
        f"{100 * record['error'][name]:+.0f} %" for name in ("iteration_s", "evaluation_s", "peak_memory_gib")
    )
    limit, none = ("| at the rate of a copy ", "| ") if rate else ("", "")
    head = f"| `{record['model']}`: side, px | iteration | transforms in it {limit}| evaluation | memory |"
    last = f"| predicted for the last, relative to it | {time_s} | {none}| {evaluation} | {memory} |"
    lines = [head, "|---" * (head.count("|") - 1) + "|", *rows, last]
    where = f"{record['gpu']}; a large copy moves {rate:,.0f} GB/s, read and written.\n\n" if rate else ""
    return where + "\n".join(lines)


def moved_gb(size_px: int) -> float:
    """What a propagation and its adjoint move at least: complex64 rows and columns of twice the side.

    Rows are read and their spectra written, columns read, multiplied with half a transfer function and
    written, rows read and written.
    """
    length = fast_length(2 * size_px - 1)
    one_way = 2 * size_px**2 + 4 * size_px * length + length**2 / 2
    return 2 * 8 * one_way / 1e9


def _clock_of_gpu() -> float:
    torch.cuda.synchronize()
    return time.perf_counter()


def _of_gpu(device: torch.device) -> dict[str, Any]:
    """Its name, and how fast it copies 4 GiB, bytes read and written."""
    from_, to = (torch.randn(2**30, device=device) for _ in range(2))
    seconds = []
    for _ in range(12):
        started = _clock_of_gpu()
        to.copy_(from_)
        seconds.append(_clock_of_gpu() - started)
    return {"gpu": torch.cuda.get_device_name(device), "copy_gb_per_s": 2 * 4 * 2**30 / min(seconds) / 1e9}


if __name__ == "__main__":
    run_script(main)
