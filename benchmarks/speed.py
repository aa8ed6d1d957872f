"""Training, prediction and design through PBL: ours against a plain implementation.

    python -m benchmarks.speed train_step [--repeats 9] [--threads 2] [--device cuda] [--publish]
    python -m benchmarks.speed predict
    python -m benchmarks.speed hoe_iteration

``train_step``: forwards, loss (L1), backwards and AdamW on four crops. ``predict``: a prediction and the
gradient to its layout. ``hoe_iteration``: one iteration of a hologram design. Plain means what a first
version does: ``benchmarks.plain_pbl``, no margin around the field, and for a design the kernel of the
propagation and its transform made anew in each call. Rows of ours: ``float32``; ``mixed``, heights in float32
and the gradient through the areawise network in bfloat16; ``bfloat16``, both so. --publish also writes the
table into docs/speed.md.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import cast, get_args

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.plain_pbl import PlainPbl
from benchmarks.side_by_side import PLAIN, Arrays, Comparison, Work, parser, relative_percent, run
from litho_data.commands.progress import run_script
from litho_data.foundation.errors import InputError
from litho_design.holograms.loss import hologram_loss
from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import load_target
from litho_design.optimisation.parameters import make_parametrisation
from litho_design.printers.source import load_printer
from litho_models import load_frozen
from litho_models.fitting.crops import Window, in_passes
from litho_models.frozen.card import ModelCard
from litho_models.frozen.files import load_simulator
from litho_models.layers.precision import Precision
from litho_models.models.pbl import Pbl, PblConfig
from litho_models.simulator import crop_border

BATCH = 4
_RATE = 1e-4


def main() -> None:
    """Measure, print, write."""
    arguments = parser(__doc__, COMPARISONS).parse_args()
    run("benchmarks.speed", COMPARISONS[arguments.task], load_pbl(arguments.model), arguments)


def load_pbl(folder: Path) -> Pbl:
    """The trained PBL in a folder, its chain alone, with weights that learn.

    Raises:
        InputError: a chain that the plain version does not have.
    """
    model = load_simulator(folder, ModelCard.read(folder))
    assert isinstance(model, Pbl)
    if model.mismatch.transposable:
        raise InputError(
            "areawise network", got="one that does not know x from y", wanted="the published one"
        )
    return model.chain()


def random_layout(config: PblConfig, size_px: int, batch: int = 1) -> Tensor:
    """Random levels on squares of 4 px, heights in µm (batch, 1, size, size)."""
    generator = torch.Generator().manual_seed(0)
    cells = -(-size_px // 4)
    level = torch.randint(0, config.levels, (batch, 1, cells, cells), generator=generator).float()
    level = level.repeat_interleave(4, -1).repeat_interleave(4, -2)[..., :size_px, :size_px]
    return (level * config.level_height_um).contiguous()


def areawise_gflop(config: PblConfig, pixels: int) -> float:
    """Multiplications and additions of the 3 x 3 layers on so many pixels, one way, GFLOP."""
    widths = (1, *config.areawise_channels, 1)
    return 2 * 9 * sum(a * b for a, b in pairwise(widths)) * pixels / 1e9


def gradient_gflop(config: PblConfig, side: str, size_px: int) -> Mapping[str, float]:
    """Convolutions forwards and back to the input, in the dtypes of that side."""
    one_way = areawise_gflop(config, size_px**2)
    if side == "mixed":
        return {"float32": one_way, "bfloat16": one_way}
    return {"bfloat16" if side == "bfloat16" else "float32": 2 * one_way}


def _training_gflop(config: PblConfig, side: str, size_px: int) -> Mapping[str, float]:
    """Convolutions forwards, back to the input and back to the weights."""
    dtype = "bfloat16" if side == "bfloat16" else "float32"
    return {dtype: 3 * areawise_gflop(config, BATCH * size_px**2)}


def _training(side: str, arguments: argparse.Namespace) -> Work:
    """Ours computes crops with their margin and in the passes of training; the plain side does neither."""
    device = torch.device(arguments.device)
    pbl = load_pbl(arguments.model)
    margin = pbl.reach_px
    wide_um = random_layout(pbl.config, arguments.size_px + 2 * margin, BATCH)
    inside_um = crop_border(wide_um, margin).contiguous()
    generator = torch.Generator().manual_seed(1)
    measured_um = inside_um + 0.05 * torch.randn(inside_um.shape, generator=generator)
    wide_um, inside_um, measured_um = (one.to(device) for one in (wide_um, inside_um, measured_um))
    plain = PlainPbl(pbl).to(device)
    model = plain if side == PLAIN else pbl.to(device)
    optimiser = torch.optim.AdamW(model.parameters(), lr=_RATE)
    reduced = torch.autocast(device.type, torch.bfloat16) if side == "bfloat16" else nullcontext()
    made: dict[str, np.ndarray] = {}

    windows = [Window(sample, 0, 0, arguments.size_px) for sample in range(BATCH)]
    passes = [windows] if side == PLAIN else in_passes(windows, device)

    def once() -> None:
        optimiser.zero_grad(set_to_none=True)
        heights_um = []
        for some in passes:
            part = slice(some[0].scan, some[-1].scan + 1)
            with reduced:
                height_um = plain(inside_um[part]) if side == PLAIN else pbl.interior(wide_um[part])
            loss = (height_um - measured_um[part]).abs().mean()
            (len(some) / BATCH * loss).backward()
            heights_um.append(height_um.detach())
        optimiser.step()
        # Those of the first step: later ones have other weights.
        made.setdefault("height_um", torch.cat(heights_um).cpu().numpy().copy())

    return once, lambda: made


def _prediction(side: str, arguments: argparse.Namespace) -> Work:
    pbl = load_pbl(arguments.model)
    device = arguments.device
    layout_um = random_layout(pbl.config, arguments.size_px).to(device).requires_grad_()
    upstream = torch.randn(layout_um.shape, generator=torch.Generator().manual_seed(1)).to(device)
    made: dict[str, Tensor] = {}
    reduced: Callable[[], AbstractContextManager[None]] = nullcontext
    if side == PLAIN:
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


def _iteration(side: str, arguments: argparse.Namespace) -> Work:
    """The plain side leaves out the guard ring of bare substrate around the element."""
    settings = hologram_settings(changes={"layout.size_px": arguments.size_px})
    layout = settings.layout
    target = load_target("text", arguments.size_px)
    device = arguments.device
    parameters = make_parametrisation(layout, settings.search).to(device)
    parameters.start_random(0)
    reduced: Callable[[], AbstractContextManager[None]] = nullcontext
    if side == PLAIN:
        pbl = PlainPbl(load_pbl(arguments.model)).to(device).requires_grad_(False)
        wanted = torch.from_numpy(target.pixels).to(device)

        def prints(level: Tensor) -> Tensor:
            return pbl(level * layout.level_height_um)

        def objective(level: Tensor) -> tuple[Tensor, dict[str, float]]:
            return hologram_loss(_propagate(prints(level)[0, 0], settings), wanted, settings.loss)

    else:
        printer = load_printer(str(arguments.model), layout, device=device)
        prints, objective = printer, HologramTask(settings, printer, target).objective
        reduced = partial(printer.at_precision, cast(Precision, side))

    def once() -> None:
        parameters.zero_grad(set_to_none=True)
        with reduced():
            loss, _ = objective(parameters.sample(1.0, True, 0))
            loss.backward()

    def made() -> Arrays:
        with torch.no_grad(), reduced():
            return {"height_um": prints(parameters.sample(1.0, True, 0)).cpu().numpy()}

    return once, made


def _propagate(height_um: Tensor, settings: HologramSettings) -> Tensor:
    """Share of the incident power per pixel of the image, by one convolution with a kernel made here."""
    optics, pitch_um = settings.optics, settings.layout.pitch_um
    size = height_um.shape[-1]
    wavenumber = 2 * math.pi / optics.wavelength_um
    x = (torch.arange(2 * size, dtype=torch.float64, device=height_um.device) - size) * pitch_um
    radius = (x[:, None] ** 2 + x[None, :] ** 2 + optics.distance_um**2).sqrt()
    kernel = optics.distance_um / (2 * math.pi * radius**2) * (1 / radius - 1j * wavenumber)
    kernel = (kernel * torch.exp(1j * wavenumber * radius) * pitch_um**2).to(torch.complex64)
    phase = height_um * (2 * math.pi / optics.wave_height_um)
    field = F.pad(torch.exp(1j * phase), (0, size, 0, size)) / size
    transfer = torch.fft.fft2(torch.fft.ifftshift(kernel))
    return torch.fft.ifft2(torch.fft.fft2(field) * transfer)[:size, :size].abs().square()


def _differences(ours: Arrays, plain: Arrays, reach_px: int) -> Mapping[str, float]:
    """Largest difference of a height, nm, and that of a gradient, where the field's edge has no say."""

    def inner(name: str, border: int) -> tuple[np.ndarray, np.ndarray]:
        inside = (..., slice(border, -border), slice(border, -border))
        return ours[name][inside] - plain[name][inside], plain[name][inside]

    off_um, _ = inner("height_um", reach_px)
    found = {"largest_difference_nm": 1000 * float(np.abs(off_um).max())}
    if "gradient" in plain:
        found["gradient_difference_percent"] = relative_percent(*inner("gradient", 2 * reach_px))
    return found


_SIDES = (PLAIN, *get_args(Precision))
COMPARISONS = {
    one.name: one
    for one in (
        Comparison(
            "train_step", (PLAIN, "float32", "bfloat16"), 256, _training, _training_gflop, _differences
        ),
        Comparison("predict", _SIDES, 1024, _prediction, gradient_gflop, _differences),
        Comparison("hoe_iteration", _SIDES, 1024, _iteration, gradient_gflop, _differences),
    )
}


if __name__ == "__main__":
    run_script(main)
