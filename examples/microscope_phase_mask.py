"""Design a phase mask for a microscope, so that the image of a point emitter shows its position in three
dimensions.

    python examples/microscope_phase_mask.py zoo:pbl

The element stands in the pupil of the microscope. The loss is the Cramer-Rao bound on the errors of x, y and
z, averaged over depth. This bound is the smallest error with which an emitter can be localised from the
photons of its image (Shechtman et al. 2014, doi:10.1103/PhysRevLett.113.133902).
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

import litho_design
from litho_data.commands.progress import run_script

WAVELENGTH_UM, APERTURE, IMMERSION = 0.6328, 0.8, 1.0
PHOTONS, BACKGROUND, STEP_UM = 3000.0, 5.0, 0.02


class Microscope:
    """A microscope with a mask in its pupil. It computes how precisely an emitter can be localised at several
    depths.
    """

    def __init__(self, size_px: int, depth_um: float):
        y, x = torch.meshgrid(*(torch.linspace(-1, 1, size_px),) * 2, indexing="ij")
        self.pupil = (torch.hypot(y, x) <= 1).to(torch.complex64)
        axial = (IMMERSION**2 - (APERTURE * torch.hypot(y, x).clamp(max=1)) ** 2).sqrt()
        depths = depth_um * torch.linspace(-0.5, 0.5, 7)
        # At each depth, images are computed with the emitter moved slightly along z, y and x. Their
        # differences give the derivatives of the image.
        axes = torch.eye(3)
        steps = STEP_UM * torch.stack([torch.zeros(3), *(sign * axis for axis in axes for sign in (1, -1))])
        path = torch.stack([axial, APERTURE * y, APERTURE * x])
        places = depths[:, None, None] * axes[0] + steps
        phase = torch.einsum("dsa,ayx->dsyx", places, path) * (2 * torch.pi / WAVELENGTH_UM)
        self.waves = torch.polar(self.pupil.abs().expand_as(phase), phase)
        self.size_px = size_px

    def errors_nm(self, element: litho_design.Element) -> torch.Tensor:
        """Return the smallest possible standard errors along z, y and x in nm, for each depth. The result has
        shape (depths, 3).
        """
        behind = element(self.waves, WAVELENGTH_UM)
        # The pupil is padded to twice its width. Pixels of the image are therefore wavelength / (4 ·
        # aperture) wide.
        image = torch.fft.fft2(behind, s=(2 * self.size_px,) * 2, norm="ortho").abs().square()
        image = torch.fft.fftshift(image / self.pupil.abs().sum(), dim=(-2, -1)) * PHOTONS
        middle = slice(self.size_px - 24, self.size_px + 24)
        image = image[..., middle, middle]
        slopes = (image[:, 1::2] - image[:, 2::2]) / (2 * STEP_UM)
        seen = image[:, 0] + BACKGROUND
        fisher = torch.einsum("dayx,dbyx,dyx->dab", slopes, slopes, 1 / seen)
        return 1000 * torch.linalg.inv(fisher + 1e-3 * torch.eye(3)).diagonal(dim1=1, dim2=2).sqrt()


def main() -> None:
    """Compare three printed elements: no mask, a mask designed for a perfect printer, and one designed with a
    model.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", help="folder of a frozen model, or zoo:NAME")
    parser.add_argument("--size-px", type=int, default=256, help="side of the mask in pixels")
    parser.add_argument("--depth-um", type=float, default=3, help="range of depths in µm")
    parser.add_argument("--iterations", type=int, default=100, help="number of iterations of each search")
    words = parser.parse_args()
    layout = {"size_px": words.size_px, "cell_um": 0.4}
    scope, judge = Microscope(words.size_px, words.depth_um), litho_design.Element(words.model, layout)
    for name, iterations in (("none", 0), ("none", words.iterations), (words.model, words.iterations)):
        element = litho_design.Element(name, layout)
        ramp = np.linspace(0, 1, words.size_px).reshape(-1, element.layout.cell_px).mean(1)
        ramp = ramp.repeat(element.layout.cell_px)[:, None].repeat(words.size_px, axis=1)
        element.start_from_levels(4 + 4 * ramp if iterations else 0 * ramp)
        optimiser = torch.optim.Adam(element.free.parameters(), lr=0.2)
        for _ in range(iterations):
            optimiser.zero_grad()
            scope.errors_nm(element).mean().backward()
            optimiser.step()
        judge.start_from_levels(element.levels())
        with torch.no_grad():
            z, y, x = scope.errors_nm(judge).mean(0).tolist()
        what = f"designed with {name}" if iterations else "no mask"
        print(
            f"{what}: after printing, mean errors of {z:.1f} nm along z, {y:.1f} along y and {x:.1f} along x"
        )


if __name__ == "__main__":
    run_script(main)
