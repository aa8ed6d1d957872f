"""One training step of PBL on four crops of 256 x 256 px, ours against a plain implementation.

    python -m benchmarks.train_step [--repeats 9] [--threads 2] [--publish]

A step is forwards, loss (L1), backwards and AdamW. Rows of ours: ``bfloat16``, the precision of the
fast recipe, and ``float32``. Ours computes crops with their margin and in the passes of training; the
plain one does neither. --publish also writes the table into docs/speed.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from contextlib import nullcontext

import numpy as np
import torch

from benchmarks import side_by_side
from benchmarks.plain_pbl import PlainPbl
from benchmarks.side_by_side import Arrays, Work
from benchmarks.trained_pbl import areawise_gflop, load_pbl, random_layout
from litho_data.foundation.commands import run_script
from litho_models.fitting.crops import Window, in_passes
from litho_models.models.pbl import PblConfig
from litho_models.simulator import crop_border

NAME = "train_step"
SIDES = (side_by_side.PLAIN, "float32", "bfloat16")
BATCH = 4
_RATE = 1e-4


def main() -> None:
    """Measure, print, write."""
    arguments = side_by_side.parser(__doc__, NAME, repeats=9, size_px=256).parse_args()
    config = load_pbl(arguments.model).config
    side_by_side.run(
        "benchmarks.train_step",
        NAME,
        arguments,
        SIDES,
        _work,
        lambda side, given: _gflop(config, side, given.size_px),
        _differences,
        batch=BATCH,
    )


def _gflop(config: PblConfig, side: str, size_px: int) -> Mapping[str, float]:
    """Convolutions forwards, back to the input and back to the weights."""
    dtype = "bfloat16" if side == "bfloat16" else "float32"
    return {dtype: 3 * areawise_gflop(config, BATCH * size_px**2)}


def _work(side: str, arguments: argparse.Namespace) -> Work:
    device = torch.device(arguments.device)
    pbl = load_pbl(arguments.model)
    margin = pbl.reach_px
    wide_um = random_layout(pbl.config, arguments.size_px + 2 * margin, BATCH)
    inside_um = crop_border(wide_um, margin).contiguous()
    generator = torch.Generator().manual_seed(1)
    measured_um = inside_um + 0.05 * torch.randn(inside_um.shape, generator=generator)
    wide_um, inside_um, measured_um = (one.to(device) for one in (wide_um, inside_um, measured_um))
    plain = PlainPbl(pbl).to(device)
    model = plain if side == side_by_side.PLAIN else pbl.to(device)
    optimiser = torch.optim.AdamW(model.parameters(), lr=_RATE)
    reduced = torch.autocast(device.type, torch.bfloat16) if side == "bfloat16" else nullcontext()
    made: dict[str, np.ndarray] = {}

    windows = [Window(sample, 0, 0, arguments.size_px) for sample in range(BATCH)]
    passes = [windows] if side == side_by_side.PLAIN else in_passes(windows, device)

    def once() -> None:
        optimiser.zero_grad(set_to_none=True)
        heights_um = []
        for some in passes:
            part = slice(some[0].scan, some[-1].scan + 1)
            with reduced:
                height_um = (
                    plain(inside_um[part]) if side == side_by_side.PLAIN else pbl.interior(wide_um[part])
                )
            loss = (height_um - measured_um[part]).abs().mean()
            (len(some) / BATCH * loss).backward()
            heights_um.append(height_um.detach())
        optimiser.step()
        # Those of the first step: later ones have other weights.
        made.setdefault("height_um", crop_border(torch.cat(heights_um), margin).cpu().numpy().copy())

    return once, lambda: made


def _differences(ours: Arrays, plain: Arrays) -> Mapping[str, float]:
    """Largest difference of a height in the first step, nm, where the edge of the crop has no say."""
    off_um = ours["height_um"] - plain["height_um"]
    return {"largest_difference_nm": 1000 * float(np.abs(off_um).max())}


if __name__ == "__main__":
    run_script(main)
