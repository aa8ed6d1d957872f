"""Memory and time of a print and score from disk: a layout of random levels, no search.

    python -m benchmarks.large_stream [--model zoo:pbl] [--size-px 8192] [--out FILE]

One process and thread; seconds of the processor, as the machine may do other work. Memory is the peak of the
process, with what it holds mapped of its files.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.record import write_record
from litho_data.foundation.commands import run_script
from litho_data.foundation.run_facts import run_facts
from litho_design.holograms.settings import hologram_settings
from litho_design.images.targets import draw_target
from litho_design.optimisation.budget import peak_memory_gib
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, TARGET_FILE, Design, write_arrays
from litho_design.workflows.large import design_large_hologram, score_from_disk

_SMALL_PX = 256


def main() -> None:
    """Make the folder of a layout, score it, write what that took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="zoo:pbl")
    parser.add_argument("--size-px", type=int, default=8192)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _layout(folder / "design", given.size_px)
        started = time.process_time()
        (score,) = score_from_disk(folder / "design", folder / "score", judges=[given.model]).scores
        seconds = time.process_time() - started
    content = {
        "schema": "litho-design/large-stream/1",
        **run_facts(),
        "model": given.model,
        "size_px": given.size_px,
        "processor_s": seconds,
        "peak_memory_gib": peak_memory_gib(),
        "figures": score.figures,
    }
    print(json.dumps(content, indent=1))
    if given.out:
        write_record(given.out, content)


def _layout(folder: Path, size_px: int) -> None:
    """The folder of a design of random levels, with the record of a small one, one band at a time."""
    changes = {"layout.size_px": _SMALL_PX, "search.iterations": 1, "search.start": "random"}
    settings = hologram_settings(changes=changes)
    record = design_large_hologram("ring", "none", folder, settings=settings, announce=False)
    layout = record.layout.model_copy(update={"size_px": size_px})
    cells, step = size_px // layout.cell_px, size_px // 1024
    levels = np.random.default_rng(0).integers(0, layout.levels, (cells, cells), np.uint8)
    levels = levels.repeat(layout.cell_px, 0).repeat(layout.cell_px, 1)
    aim = draw_target("ring", 1024).repeat(step, 0).repeat(step, 1)
    files: dict[str, str] = {}
    for name, array in ((LEVELS_FILE, levels), (TARGET_FILE, aim), (IMAGE_FILE, aim)):
        files |= write_arrays(folder, {name: array})
    del aim
    files |= write_arrays(folder, {HEIGHT_FILE: levels * np.float32(layout.level_height_um)})
    Design.model_validate(record.model_dump(by_alias=True) | {"layout": layout, "files": files}).write(folder)


if __name__ == "__main__":
    run_script(main)
