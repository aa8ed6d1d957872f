"""One iteration of a hologram design through PBL: ours against a plain implementation.

    python benchmarks/hoe_iteration.py [--model DIR] [--size-px 1024] [--iterations 3] [--threads 2]

Plain means what a first version does: the Rayleigh-Sommerfeld kernel and its transform are rebuilt
on every call, fields are complex and padded to twice the size, blurs are complex transforms, the
pointwise networks run per pixel as 1 x 1 convolutions, everything is float32 in NCHW, and nobody
thought of freezing the weights, so they collect gradients too. Both sides have the same weights, the
same guard ring and the same layout; each row runs in a process of its own, so that peak memories can
be compared. Rows of ours: ``float32`` is exact to rounding; ``mixed`` prints in float32 and sends the
gradient back through the areawise network in bfloat16; ``bfloat16`` does both so.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from litho_design.hoe import HoeTask
from litho_design.hologram import image_error
from litho_design.optimise import make_parametrisation
from litho_design.printer import load_printer
from litho_design.settings import hoe_preset
from litho_design.targets import make_target
from litho_models import load_frozen, save_frozen
from litho_models.models import model_class

SIDES = ("plain", "float32", "mixed", "bfloat16")


def main() -> None:
    arguments = _arguments()
    if arguments.side:
        print(json.dumps(_measure(arguments)))
        return
    with tempfile.TemporaryDirectory() as folder:
        model = arguments.model or str(_untrained(Path(folder) / "model"))
        results = {side: _run(side, model, arguments, Path(folder)) for side in SIDES}
        heights = {side: np.load(Path(folder) / f"{side}.npy") for side in SIDES}
    plain = results["plain"]
    print(
        f"{'':10}{'s/iteration':>12}{'peak GiB':>10}{'faster':>9}{'memory':>9}{'max diff nm':>13}{'loss':>12}"
    )
    for side, item in results.items():
        difference_nm = 1000 * float(np.abs(heights[side] - heights["plain"]).max())
        print(
            f"{side:10}{item['seconds']:12.2f}{item['peak_gib']:10.2f}"
            f"{plain['seconds'] / item['seconds']:8.1f}x{item['peak_gib'] / plain['peak_gib']:9.2f}"
            f"{difference_nm:13.4f}{item['loss']:12.6f}"
        )
    print(_roofline(arguments.size_px, arguments.threads))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", help="folder of a frozen PBL; default: random weights")
    parser.add_argument("--size-px", type=int, default=1024)
    parser.add_argument("--iterations", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--side", choices=SIDES)
    parser.add_argument("--height-file")
    return parser.parse_args()


def _run(side: str, model: str, arguments: argparse.Namespace, folder: Path) -> dict[str, float]:
    command = [sys.executable, __file__, "--side", side, "--model", model]
    command += ["--size-px", str(arguments.size_px), "--iterations", str(arguments.iterations)]
    command += ["--threads", str(arguments.threads), "--height-file", str(folder / f"{side}.npy")]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def _untrained(folder: Path) -> Path:
    torch.manual_seed(0)
    kind = model_class("pbl")
    pbl = kind(kind.Config())
    for parameter in pbl.parameters():
        parameter.data += 0.02 * torch.randn_like(parameter)
    return save_frozen(pbl, folder)


def _measure(arguments: argparse.Namespace) -> dict[str, float]:
    torch.set_num_threads(arguments.threads)
    settings = hoe_preset("default")
    layout = settings.layout.model_copy(update={"size_px": arguments.size_px})
    settings = settings.model_copy(update={"layout": layout})
    target, record = make_target("text", arguments.size_px)
    parameters = make_parametrisation(layout, settings.search)
    parameters.start_random(0)
    level = parameters.sample(1.0, True, 0).detach()
    if arguments.side == "plain":
        plain = _Plain(load_frozen(arguments.model).simulator, settings, torch.from_numpy(target))
        seconds, loss = _time(plain.objective, parameters, arguments.iterations)
        with torch.no_grad():
            height = plain.print_height(level)
    else:
        printer = load_printer(arguments.model, layout)
        task = HoeTask(settings, printer, target, record)
        with printer.at_precision(arguments.side):
            seconds, loss = _time(task.objective, parameters, arguments.iterations)
            with torch.no_grad():
                height = printer(level)[0, 0]
    np.save(arguments.height_file, height.numpy())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20)
    return {"seconds": seconds, "peak_gib": peak, "loss": loss}


def _time(objective, parameters, iterations: int) -> tuple[float, float]:
    """Median time of an iteration after a first one that only warms up, and the loss."""
    seconds = []
    for iteration in range(iterations + 1):
        started = time.perf_counter()
        loss, _ = objective(parameters.sample(1.0, True, iteration))
        loss.backward()
        seconds.append(time.perf_counter() - started)
    return sorted(seconds[1:])[iterations // 2], float(loss.detach())


def _roofline(size_px: int, threads: int) -> str:
    """What the hidden convolutions alone cost in float32, there and back, at this machine's sgemm rate."""
    torch.set_num_threads(threads)
    channels = model_class("pbl").Config().areawise_channels
    taps = 9 * sum(a * b for a, b in pairwise(channels))
    flop = 2 * 2 * taps * size_px**2
    square = torch.randn(2048, 2048)
    rates = []
    for _ in range(5):
        started = time.perf_counter()
        square @ square
        rates.append(2 * 2048**3 / (time.perf_counter() - started))
    return (
        f"hidden convolutions, forward and input gradient: {flop / 1e9:.0f} GFLOP, "
        f"{flop / max(rates):.2f} s at {max(rates) / 1e9:.0f} GFLOP/s (sgemm): no exact float32 method "
        "without fewer multiplications is faster"
    )


class _Plain:
    """The same model and optics without any of the shortcuts."""

    def __init__(self, pbl, settings, target: Tensor):
        self.pbl, self.settings, self.target = pbl.requires_grad_(True), settings, target
        self.guard = math.ceil(pbl.reach_um / settings.layout.pitch_um)

    def objective(self, level: Tensor) -> tuple[Tensor, dict[str, float]]:
        share = self._propagate(self.print_height(level))
        rmse, efficiency = image_error(share, self.target, "paper")
        return rmse + 0.1 * (1 - efficiency), {}

    def print_height(self, level: Tensor) -> Tensor:
        pbl, guard = self.pbl, self.guard
        layout = F.pad(level * self.settings.layout.level_height_um, (guard,) * 4)
        initial = self._blur(layout, pbl.config.sigma_optical_um)
        initial = initial + self._pointwise(pbl.thresh, initial)
        dose = self._blur(initial, float(pbl.sigma_diffusion_um.detach()))
        product = initial * (1 + self._pointwise(pbl.shrink, dose))
        features = product.contiguous()
        for layer in pbl.mismatch.hidden:
            weight = layer.weight.contiguous()
            features = F.leaky_relu(
                F.conv2d(features, weight, layer.bias, padding=1), pbl.mismatch.leaky_slope
            )
        last = pbl.mismatch.last
        height = product + F.conv2d(features, last.weight.contiguous(), last.bias, padding=1)
        return height[0, 0, guard:-guard, guard:-guard]

    def _pointwise(self, net, values: Tensor) -> Tensor:
        """The network as 1 x 1 convolutions on every pixel."""
        features = values
        for layer in net.layers:
            if isinstance(layer, torch.nn.Linear):
                features = F.conv2d(features, layer.weight[:, :, None, None], layer.bias)
            else:
                features = layer(features)
        return features

    def _blur(self, field: Tensor, sigma_um: float) -> Tensor:
        radius = math.ceil(4 * sigma_um / self.settings.layout.pitch_um)
        x = torch.arange(-radius, radius + 1) * self.settings.layout.pitch_um
        kernel = torch.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / (2 * sigma_um**2))
        size = [n + 2 * radius for n in field.shape[-2:]]
        padded = F.pad(field, (radius,) * 4, mode="replicate")
        transfer = torch.fft.fft2(kernel / kernel.sum(), s=size)
        blurred = torch.fft.ifft2(torch.fft.fft2(padded) * transfer).real
        return blurred[..., 2 * radius :, 2 * radius :]

    def _propagate(self, height_um: Tensor) -> Tensor:
        optics, pitch = self.settings.optics, self.settings.layout.pitch_um
        size = height_um.shape[-1]
        wavenumber = 2 * math.pi / optics.wavelength_um
        x = (torch.arange(2 * size, dtype=torch.float64) - size) * pitch
        radius = (x[:, None] ** 2 + x[None, :] ** 2 + optics.distance_um**2).sqrt()
        kernel = optics.distance_um / (2 * math.pi * radius**2) * (1 / radius - 1j * wavenumber)
        kernel = (kernel * torch.exp(1j * wavenumber * radius) * pitch**2).to(torch.complex64)
        phase = height_um * (2 * math.pi / optics.wave_height_um)
        field = F.pad(torch.exp(1j * phase), (0, size, 0, size)) / size
        transfer = torch.fft.fft2(torch.fft.ifftshift(kernel))
        out = torch.fft.ifft2(torch.fft.fft2(field) * transfer)[:size, :size]
        return out.abs().square()


if __name__ == "__main__":
    main()
