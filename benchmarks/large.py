"""Hologram iterations in bands at growing sizes, and how well a model of their cost meets a size left out.

    python -m benchmarks.large [--model zoo:pbl] [--sizes 512 1024 2048] [--left-out 4096] [--out FILE]

One process, one thread, seconds of the processor: the machine may do other work. The model is fitted to
``--sizes`` and compared with ``--left-out``, which is measured last. Memory is the process's peak so far.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch

from benchmarks.record import write_record
from litho_data.foundation.commands import run_script
from litho_data.foundation.run_facts import run_facts
from litho_design.holograms.settings import hologram_settings
from litho_design.large.cost import fit_cost, measure_size
from litho_design.printers.source import load_printer


def main() -> None:
    """Measure, fit, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="zoo:pbl")
    parser.add_argument("--band-px", type=int, default=512)
    parser.add_argument("--sizes", type=int, nargs="+", default=[512, 1024, 2048])
    parser.add_argument("--left-out", type=int, default=4096)
    parser.add_argument("--out", type=Path)
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
    content = {
        "schema": "litho-design/large-cost/1",
        **run_facts(),
        "model": given.model,
        "band_px": given.band_px,
        "measured": [one.model_dump() for one in measured],
        "fit": model.model_dump(),
        "predicted": predicted,
        "error": {name: value / getattr(left_out, name) - 1 for name, value in predicted.items()},
        "iteration_ns_per_px": [1e9 * one.iteration_s / one.size_px**2 for one in measured],
    }
    print(json.dumps(content, indent=1))
    if given.out:
        write_record(given.out, content)


if __name__ == "__main__":
    run_script(main)
