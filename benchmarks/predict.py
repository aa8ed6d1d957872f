"""Frozen PBL: one prediction with the gradient to its layout, ours against a plain implementation.

    python -m benchmarks.predict [--size-px 1024] [--repeats 7] [--threads 2] [--publish]

Rows of ours: ``float32``; ``mixed``, heights in float32 and the gradient through the areawise network
in bfloat16; ``bfloat16``, both so. --publish also writes the table into docs/speed.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import cast, get_args

import numpy as np
import torch

from benchmarks import side_by_side
from benchmarks.plain_pbl import PlainPbl
from benchmarks.side_by_side import Arrays, Work
from benchmarks.trained_pbl import areawise_gflop, load_pbl, random_layout
from litho_data.foundation.commands import run_script
from litho_models import load_frozen
from litho_models.layers.precision import Precision
from litho_models.models.pbl import PblConfig

NAME = "predict"
SIDES = (side_by_side.PLAIN, *get_args(Precision))


def main() -> None:
    """Measure, print, write."""
    arguments = side_by_side.parser(__doc__, NAME, repeats=7, size_px=1024).parse_args()
    pbl = load_pbl(arguments.model)
    side_by_side.run(
        "benchmarks.predict",
        NAME,
        arguments,
        SIDES,
        _work,
        lambda side, given: gradient_gflop(pbl.config, side, given.size_px**2),
        lambda ours, plain: _differences(ours, plain, pbl.reach_px),
    )


def gradient_gflop(config: PblConfig, side: str, pixels: int) -> Mapping[str, float]:
    """Convolutions forwards and back to the input, in the dtypes of that side."""
    one_way = areawise_gflop(config, pixels)
    if side == "mixed":
        return {"float32": one_way, "bfloat16": one_way}
    return {"bfloat16" if side == "bfloat16" else "float32": 2 * one_way}


def _work(side: str, arguments: argparse.Namespace) -> Work:
    pbl = load_pbl(arguments.model)
    device = arguments.device
    layout_um = random_layout(pbl.config, arguments.size_px).to(device).requires_grad_()
    upstream = torch.randn(layout_um.shape, generator=torch.Generator().manual_seed(1)).to(device)
    made: dict[str, torch.Tensor] = {}
    reduced: Callable[[], AbstractContextManager[None]] = nullcontext
    if side == side_by_side.PLAIN:
        model: torch.nn.Module = PlainPbl(pbl).to(device).requires_grad_(False)
    else:
        model = frozen = load_frozen(arguments.model, device=device)
        reduced = partial(frozen.at_precision, cast(Precision, side))

    def once() -> None:
        with reduced():
            height_um = model(layout_um)
        (gradient,) = torch.autograd.grad(height_um, layout_um, upstream)
        made.update(height_um=height_um.detach(), gradient=gradient)

    return once, lambda: {name: array.cpu().numpy() for name, array in made.items()}


def _differences(ours: Arrays, plain: Arrays, reach_px: int) -> Mapping[str, float]:
    """Largest difference of a height, nm, and that of the gradient, where the field's edge has no say."""
    height, gradient = (
        (..., slice(border, -border), slice(border, -border)) for border in (reach_px, 2 * reach_px)
    )
    off_um = ours["height_um"][height] - plain["height_um"][height]
    reference = plain["gradient"][gradient]
    return {
        "largest_difference_nm": 1000 * float(np.abs(off_um).max()),
        "gradient_difference_percent": side_by_side.relative_percent(
            ours["gradient"][gradient] - reference, reference
        ),
    }


if __name__ == "__main__":
    run_script(main)
