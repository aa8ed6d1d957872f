"""Design a lens with an extended depth of focus. Its spot stays bright over a range of distances.

    python examples/extended_focus.py zoo:pbl

The search varies the heights of concentric rings, and starts from a plain lens. The loss rewards brightness
on the axis, mainly in the planes where it is lowest.
"""

from __future__ import annotations

import argparse

import torch

import litho_design
from litho_data.commands.progress import run_script
from litho_design.optics import centred_grid, make_propagator

WAVELENGTH_UM, PLANES = 0.6328, 9


class Axis:
    """The optical axis behind a lens. It computes the brightness of the central spot in several planes,
    relative to the focus of a perfect lens.
    """

    def __init__(self, element: litho_design.Element, focal_um: float, range_um: float):
        size, pitch = element.layout.size_px, element.layout.pitch_um
        grid, spot = centred_grid((size, size), pitch), centred_grid((6, 6), pitch)
        optics = element.optics(WAVELENGTH_UM)
        planes = (focal_um + range_um * torch.linspace(-0.5, 0.5, PLANES)).tolist()
        self.propagators = [
            make_propagator(grid, spot, optics.model_copy(update={"distance_um": z})) for z in planes
        ]
        y, x = torch.from_numpy(grid.y_um)[:, None], torch.from_numpy(grid.x_um)[None, :]
        self.wave = (torch.hypot(y, x) < size * pitch / 2).to(torch.complex64)
        path = focal_um - (y**2 + x**2 + focal_um**2).sqrt()
        self.lens_phase = (2 * torch.pi / WAVELENGTH_UM * path).float()
        focused = torch.polar(self.wave.abs(), self.lens_phase)
        self.peak = self._light(self.propagators[PLANES // 2], focused)

    def brightness(self, element: litho_design.Element) -> torch.Tensor:
        """Return the relative brightness in each plane, as an array of shape (planes,)."""
        behind = element(self.wave, WAVELENGTH_UM)
        return torch.stack([self._light(go, behind) for go in self.propagators]) / self.peak

    def _light(self, propagator: torch.nn.Module, wave: torch.Tensor) -> torch.Tensor:
        return propagator(wave).abs().square().sum()


def main() -> None:
    """Compare three printed lenses: a plain lens, one designed for a perfect printer, and one designed with a
    model.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", help="folder of a frozen model, or zoo:NAME")
    parser.add_argument("--size-px", type=int, default=320, help="side of the lens in pixels")
    parser.add_argument("--focal-um", type=float, default=60, help="focal length in µm")
    parser.add_argument("--range-um", type=float, default=30, help="range of distances in µm")
    parser.add_argument("--iterations", type=int, default=100, help="number of iterations of each search")
    words = parser.parse_args()
    layout = {"size_px": words.size_px, "cell_um": 0.2, "symmetry": "radial"}
    judge = litho_design.Element(words.model, layout)
    axis = Axis(judge, words.focal_um, words.range_um)
    for name, iterations in ((words.model, 0), ("none", words.iterations), (words.model, words.iterations)):
        element = litho_design.Element(name, layout)
        element.start_from_phase(axis.lens_phase, WAVELENGTH_UM)
        optimiser = torch.optim.Adam(element.free.parameters(), lr=0.2)
        for _ in range(iterations):
            optimiser.zero_grad()
            # The loss is a soft minimum of the brightness, in which the dimmest planes have the largest
            # weight.
            torch.logsumexp(-3 * axis.brightness(element).log(), 0).backward()
            optimiser.step()
        judge.start_from_levels(element.levels())
        with torch.no_grad():
            seen = axis.brightness(judge)
        what = f"designed with {name}" if iterations else "a plain lens"
        print(f"{what}: after printing, the brightness is {float(seen.min()):.3f} to {float(seen.max()):.3f}")


if __name__ == "__main__":
    run_script(main)
