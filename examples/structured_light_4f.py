"""Shape light in a 4f system, in which a printed element converts a vortex beam into a Gaussian beam.

    python examples/structured_light_4f.py zoo:pbl

The system has two lenses with the element between them, in the Fourier plane. It is simulated with
torchoptics (install the extra ``torchoptics``), whose lengths are in m. A vortex beam has no overlap with a
Gaussian beam, so the element must unwind the phase of the vortex.
"""

from __future__ import annotations

import argparse

import torch
import torchoptics
from torchoptics.elements import Lens
from torchoptics.profiles import gaussian, laguerre_gaussian

import litho_design
from litho_data.commands.progress import run_script

WAVELENGTH, PITCH = 632.8e-9, 0.1e-6


def overlap(
    element: litho_design.Element, f: float, vortex: torchoptics.Field, wanted: torchoptics.Field
) -> torch.Tensor:
    """Return the share of the light that is in the target beam ``wanted`` behind a 4f system. The input of
    the system is ``vortex``, and its lenses have the focal length ``f``.
    """
    shape = vortex.shape
    between = element.as_torchoptics(z=2 * f, unit_um=1e6)
    system = torchoptics.System(Lens(shape, f, f), between, Lens(shape, f, 3 * f))
    return wanted.inner(system.measure_at_z(vortex, 4 * f)).abs().square()


def main() -> None:
    """Design one element for a perfect printer and one with a model, and print both with the model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", help="folder of a frozen model, or zoo:NAME")
    parser.add_argument("--size-px", type=int, default=256, help="side of the element in pixels")
    parser.add_argument("--focal-um", type=float, default=100, help="focal length of the lenses in µm")
    parser.add_argument("--waist-um", type=float, default=3, help="waist of both beams in µm")
    parser.add_argument("--iterations", type=int, default=100, help="number of iterations of each search")
    words = parser.parse_args()
    f, waist = 1e-6 * words.focal_um, 1e-6 * words.waist_um
    torchoptics.set_default_wavelength(WAVELENGTH)
    torchoptics.set_default_spacing(PITCH)
    layout, shape = {"size_px": words.size_px, "cell_um": 0.2}, (words.size_px, words.size_px)
    vortex = torchoptics.Field(laguerre_gaussian(shape, 0, 1, waist)).normalize()
    wanted = torchoptics.Field(gaussian(shape, waist), z=4 * f).normalize()
    judge = litho_design.Element(words.model, layout)
    for name in ("none", words.model):
        element = litho_design.Element(name, layout)
        optimiser = torch.optim.Adam(element.free.parameters(), lr=0.5)
        for _ in range(words.iterations):
            optimiser.zero_grad()
            (-overlap(element, f, vortex, wanted).log()).backward()
            optimiser.step()
        judge.start_from_levels(element.levels())
        with torch.no_grad():
            share = float(overlap(judge, f, vortex, wanted))
        print(
            f"designed with {name}: after printing, {100 * share:.1f} % of the light is in the Gaussian beam"
        )


if __name__ == "__main__":
    run_script(main)
