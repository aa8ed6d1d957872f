"""One iteration of a hologram design through PBL: ours against a plain implementation.

    python benchmarks/hoe_iteration.py [--size-px 1024] [--iterations 3] [--threads 2]

Plain means what a first version does: the Rayleigh-Sommerfeld kernel and its transform are rebuilt
on every call, fields are complex and padded to twice the size, the pointwise networks run per pixel
and convolutions in float32 NCHW, with autograd keeping everything. Both sides have the same weights
and the same layout; each runs in a process of its own, so that peak memories can be compared.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time

import torch
import torch.nn.functional as F
from torch import Tensor

from litho_design.hoe import HoeTask
from litho_design.hologram import image_error
from litho_design.optimise import make_parametrisation
from litho_design.printer import Printer
from litho_design.settings import hoe_preset
from litho_design.targets import make_target
from litho_models.models import model_class


def main() -> None:
    arguments = _arguments()
    if arguments.side:
        print(json.dumps(_measure(arguments)))
        return
    results = {}
    for side in ("plain", "ours", "ours-bfloat16"):
        command = [sys.executable, __file__, "--side", side, "--size-px", str(arguments.size_px)]
        command += ["--iterations", str(arguments.iterations), "--threads", str(arguments.threads)]
        results[side] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    plain = results["plain"]
    print(f"{'':16}{'s/iteration':>12}{'peak GiB':>10}{'loss':>12}{'faster':>9}{'memory':>9}")
    for side, item in results.items():
        print(
            f"{side:16}{item['seconds']:12.2f}{item['peak_gib']:10.2f}{item['loss']:12.6f}"
            f"{plain['seconds'] / item['seconds']:8.1f}x{item['peak_gib'] / plain['peak_gib']:9.2f}"
        )


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size-px", type=int, default=1024)
    parser.add_argument("--iterations", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--side", choices=["plain", "ours", "ours-bfloat16"])
    return parser.parse_args()


def _measure(arguments: argparse.Namespace) -> dict[str, float]:
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    settings = hoe_preset("default")
    layout = settings.layout.model_copy(update={"size_px": arguments.size_px})
    settings = settings.model_copy(update={"layout": layout})
    kind = model_class("pbl")
    pbl = kind(kind.Config())
    for parameter in pbl.parameters():
        parameter.data += 0.02 * torch.randn_like(parameter)
    pbl.requires_grad_(False)
    target, record = make_target("text", arguments.size_px)
    printer = Printer(_Called(pbl), layout, source="benchmark")
    task = HoeTask(settings, printer, target, record)
    if arguments.side == "plain":
        plain = _Plain(pbl, settings, torch.from_numpy(target))
        objective = plain.objective
    else:
        objective = task.objective
    parameters = make_parametrisation(layout, settings.search)
    parameters.start_random(0)
    precision = "bfloat16" if arguments.side == "ours-bfloat16" else "float32"
    seconds = []
    with printer.at_precision(precision):
        for iteration in range(arguments.iterations):
            started = time.perf_counter()
            loss, _ = objective(parameters.sample(1.0, True, iteration))
            loss.backward()
            seconds.append(time.perf_counter() - started)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20)
    return {"seconds": sorted(seconds)[len(seconds) // 2], "peak_gib": peak, "loss": float(loss.detach())}


class _Called(torch.nn.Module):
    """A simulator called as a frozen model is."""

    def __init__(self, simulator):
        super().__init__()
        self.simulator = simulator
        self.name, self.reach_um = "pbl", simulator.reach_um

    def forward(self, layout_um: Tensor, pitch_um: float) -> Tensor:
        return self.simulator(layout_um)


class _Plain:
    """The same model and optics without any of the shortcuts."""

    def __init__(self, pbl, settings, target: Tensor):
        self.pbl, self.settings, self.target = pbl, settings, target
        self.guard = math.ceil(pbl.reach_um / settings.layout.pitch_um)

    def objective(self, level: Tensor) -> tuple[Tensor, dict[str, float]]:
        share = self._propagate(self._print(level))
        rmse, efficiency = image_error(share, self.target, "paper")
        return rmse + 0.1 * (1 - efficiency), {}

    def _print(self, level: Tensor) -> Tensor:
        pbl, guard = self.pbl, self.guard
        layout = F.pad(level * self.settings.layout.level_height_um, (guard,) * 4)
        initial = self._blur(layout, pbl.config.sigma_optical_um)
        initial = initial + self._pointwise(pbl.thresh, initial)
        dose = self._blur(initial, float(pbl.sigma_diffusion_um))
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
