"""Measure the time and the memory that predictions and designs need with each model of the zoo.

    python -m benchmarks.speed [--size-px 256] [--threads 1] [--device cuda] [--publish]

Each model is measured in a process of its own. With --publish, the table is also written into docs/speed.md.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin, usable_cores
from litho_data.commands.progress import run_script
from litho_design.holograms.settings import hologram_settings
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import load_target
from litho_design.optimisation.budget import peak_memory_gib
from litho_design.optimisation.parameters import DirectLevels
from litho_design.printers.source import check_device, load_printer
from litho_models.frozen import zoo
from litho_models.frozen.card import ModelCard

PAGE = Path(__file__).parents[1] / "docs" / "speed.md"
OUT = PAGE.parent / "results" / "speed" / "speed.json"
MODELS = ("physics", "pbl", "fno", "random-features")
REPEATS = 3


def main() -> None:
    """Measure every model, write the record, and print the table."""
    parser = options(__doc__, "write the table into docs/speed.md", OUT)
    parser.add_argument("--models", default=",".join(MODELS), help="models of the zoo, separated by commas")
    parser.add_argument("--size-px", type=int, default=256, help="side of the layout in pixels")
    parser.add_argument("--threads", type=int, default=1, help="number of threads")
    parser.add_argument("--device", default="cpu", help="cpu, or cuda for a GPU")
    parser.add_argument("--here", action="store_true", help="measure one model in this process")
    given = parser.parse_args()
    if given.here:
        print(json.dumps(measured(given.models, given.size_px, given.threads, given.device)))
        return
    check_device(given.device)
    rows = []
    for name in given.models.split(","):
        words = [
            "--models",
            name,
            "--size-px",
            given.size_px,
            "--threads",
            given.threads,
            "--device",
            given.device,
        ]
        command = [sys.executable, "-m", "benchmarks.speed", "--here", *map(str, words)]
        rows.append(json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout))
    record = {
        "schema": "litho-models/benchmark-speed/2",
        "size_px": given.size_px,
        "threads": given.threads,
        "device": torch.cuda.get_device_name(given.device) if given.device != "cpu" else "CPU",
        "cores": usable_cores(),
        **origin(),
        "models": rows,
    }
    conclude(record, as_markdown(record), given.out, PAGE, "speed", published=given.publish)


def measured(name: str, size_px: int, threads: int, device: str) -> dict[str, Any]:
    """Measure one model. Return the seconds that a prediction with its gradient and an iteration of a
    hologram design take, and the peak memory.
    """
    torch.set_num_threads(threads)
    settings = hologram_settings(changes={"layout.size_px": size_px})
    printer = load_printer(f"{zoo.PREFIX}{name}", settings.layout, device=device)
    task = HologramTask(settings, printer, inputs={"target": load_target("text", size_px).pixels})
    parameters = DirectLevels(settings.layout).to(device)
    parameters.start_random(0)
    level = parameters.sample(hard=True).detach().requires_grad_()

    def predict() -> None:
        torch.autograd.grad(printer(level).sum(), level)

    def iterate() -> None:
        parameters.zero_grad(set_to_none=True)
        task.objective(parameters.sample(hard=True))[0].backward()

    return {
        "model": name,
        "training_s": ModelCard.read(zoo.folder(name)).training["seconds"],
        "predict_s": _seconds(predict, device),
        "iteration_s": _seconds(iterate, device),
        "peak_gib": peak_memory_gib(torch.device(device)),
    }


def as_markdown(record: Mapping[str, Any]) -> str:
    """Return the record as a table in Markdown."""
    size_px = record["size_px"]
    rows = [
        (
            row["model"],
            f"{row['training_s']:,.0f} s",
            f"{row['predict_s']:.2f} s",
            f"{row['iteration_s']:.2f} s",
            f"{row['peak_gib']:.2f} GiB",
        )
        for row in record["models"]
    ]
    clock = "processor" if record["device"] == "CPU" else "wall-clock"
    heads = (
        "model",
        "training on 20 scans",
        "prediction with its gradient",
        "an iteration of a hologram design",
        "peak memory",
    )
    return markdown_table(
        heads,
        rows,
        f"The layouts have {size_px} × {size_px} px. The times were measured in float32 on the "
        f"{record['device']} with {record['threads']} thread{'s' * (record['threads'] > 1)} and torch "
        f"{record['versions']['torch']}. The times of prediction and design are {clock} times and "
        f"medians of {REPEATS} runs. The times of training are wall-clock times on a computer that did other "
        "work at the same time.",
    )


def _seconds(work: Callable[[], None], device: str) -> float:
    """Return the median time that ``work`` takes, in seconds. It is processor time on the CPU, and wall-clock
    time on a GPU.
    """
    clock = time.process_time if device == "cpu" else time.perf_counter

    def once() -> float:
        started = clock()
        work()
        if device != "cpu":
            torch.cuda.synchronize(device)
        return clock() - started

    once()
    return median(once() for _ in range(REPEATS))


if __name__ == "__main__":
    run_script(main)
