"""One iteration of a hologram design through PBL: ours against a plain implementation.

    python -m benchmarks.hoe_iteration [--size-px 1024] [--repeats 5] [--threads 2] [--publish]

Plain means what a first version does: the Rayleigh-Sommerfeld kernel and its transform are made anew
in each call, fields are complex and padded to twice the size, and the print is that of
``benchmarks.plain_pbl``. It leaves out the guard ring of bare substrate around the element, which ours
computes. Rows of ours: ``float32``; ``mixed``, heights in float32 and the gradient through the areawise
network in bfloat16; ``bfloat16``, both so. --publish also writes the table into docs/speed.md.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks import side_by_side
from benchmarks.plain_pbl import PlainPbl
from benchmarks.predict import SIDES, gradient_gflop
from benchmarks.side_by_side import Arrays, Work
from benchmarks.trained_pbl import load_pbl
from litho_data.foundation.commands import run_script
from litho_design.holograms.loss import hologram_loss
from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import load_target
from litho_design.optimisation.parameters import make_parametrisation
from litho_design.printers.source import load_printer
from litho_models.layers.precision import Precision

NAME = "hoe_iteration"


def main() -> None:
    """Measure, print, write."""
    arguments = side_by_side.parser(__doc__, NAME, repeats=5, size_px=1024).parse_args()
    pbl = load_pbl(arguments.model)
    side_by_side.run(
        "benchmarks.hoe_iteration",
        NAME,
        arguments,
        SIDES,
        _work,
        lambda side, given: gradient_gflop(pbl.config, side, given.size_px**2),
        lambda ours, plain: _differences(ours, plain, pbl.reach_px),
    )


def _work(side: str, arguments: argparse.Namespace) -> Work:
    settings = hologram_settings("default")
    layout = settings.layout.model_copy(update={"size_px": arguments.size_px})
    settings = settings.model_copy(update={"layout": layout})
    target = load_target("text", arguments.size_px)
    device = arguments.device
    parameters = make_parametrisation(layout, settings.search).to(device)
    parameters.start_random(0)
    reduced: Callable[[], AbstractContextManager[None]] = nullcontext
    if side == side_by_side.PLAIN:
        pbl = PlainPbl(load_pbl(arguments.model)).to(device).requires_grad_(False)
        wanted = torch.from_numpy(target.pixels).to(device)

        def prints(level: Tensor) -> Tensor:
            return pbl(level * layout.level_height_um)

        def objective(level: Tensor) -> tuple[Tensor, dict[str, float]]:
            share = _propagate(prints(level)[0, 0], settings)
            return hologram_loss(share, wanted, settings.loss)

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


def _differences(ours: Arrays, plain: Arrays, reach_px: int) -> Mapping[str, float]:
    """Largest difference of a printed height, nm, farther than the receptive radius from the edge."""
    inner = (..., slice(reach_px, -reach_px), slice(reach_px, -reach_px))
    off_um = ours["height_um"][inner] - plain["height_um"][inner]
    return {"largest_difference_nm": 1000 * float(np.abs(off_um).max())}


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


if __name__ == "__main__":
    run_script(main)
