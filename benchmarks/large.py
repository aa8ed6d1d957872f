"""Hologram iterations in bands at growing sizes, and how well a model of their cost meets a size left out.

    python -m benchmarks.large [--model zoo:pbl] [--sizes 1024 2048] [--left-out 4096] [--publish]

One process, one thread, seconds of the processor: the machine may do other work. The model is fitted to the
largest of ``--sizes`` and compared with ``--left-out``, which is measured last. Memory is the process's peak
so far. ``--publish`` puts the table into docs/large.md.
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
from litho_design.printers.source import load_printer

_DOCS = Path(__file__).parents[1] / "docs"


def main() -> None:
    """Measure, fit, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="zoo:pbl")
    parser.add_argument("--band-px", type=int, default=512)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1024, 2048])
    parser.add_argument("--left-out", type=int, default=4096)
    parser.add_argument("--out", type=Path, help="JSON file; docs/results/large/MODEL.json by default")
    parser.add_argument("--publish", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    settings = hologram_settings()
    printer = load_printer(given.model, settings.layout)
    measured = []
    for size in [*given.sizes, given.left_out]:
        measured.append(measure_size(settings, printer, size, given.band_px, time.process_time))
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
        "measured": [one.model_dump() for one in measured],
        "fit": model.model_dump(),
        "predicted": predicted,
        "error": error,
    }
    out = given.out or _DOCS / "results" / "large" / f"{printer.name}.json"
    conclude(
        content,
        as_markdown(content),
        out,
        _DOCS / "large.md",
        f"large-{printer.name}",
        published=given.publish,
    )


def as_markdown(record: Mapping[str, Any]) -> str:
    """The table of the page, of a record."""
    rows = [
        f"| {one['size_px']:,} | {one['iteration_s']:.2f} s | {one['transforms_s']:.2f} s "
        f"| {one['evaluation_s']:.2f} s | {one['peak_memory_gib']:.2f} GiB |"
        for one in record["measured"]
    ]
    time_s, evaluation, memory = (
        f"{100 * record['error'][name]:+.0f} %" for name in ("iteration_s", "evaluation_s", "peak_memory_gib")
    )
    head = f"| `{record['model']}`: side, px | iteration | transforms in it | evaluation | memory |"
    last = f"| foretold of the last | {time_s} | | {evaluation} | {memory} |"
    return "\n".join([head, "|---|---|---|---|---|", *rows, last])


if __name__ == "__main__":
    run_script(main)
