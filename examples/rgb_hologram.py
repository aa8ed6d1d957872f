"""Design a hologram for three colours. One printed relief draws a red, a green and a blue disc that overlap.

    python examples/rgb_hologram.py zoo:pbl

``litho_design.Element`` is a torch module that maps a wave and its wavelength to the wave behind the print.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

import litho_design
from litho_data.commands.progress import run_script
from litho_design.optics import centred_grid, make_propagator

COLOURS_UM = (0.640, 0.532, 0.473)


def discs(size_px: int) -> torch.Tensor:
    """Return pictures of three overlapping discs with the values 0 and 1, as an array of shape (3, size,
    size).
    """
    y, x = np.mgrid[0:size_px, 0:size_px] / size_px - 0.5
    angles = 2 * np.pi * np.arange(3) / 3
    return torch.tensor(
        np.stack([np.hypot(y - 0.15 * np.sin(a), x - 0.15 * np.cos(a)) < 0.2 for a in angles])
    ).float()


class Scene:
    """A scene in which three colours illuminate an element. It computes their images at a distance behind
    it.
    """

    def __init__(self, size_px: int, distance_um: float, element: litho_design.Element):
        grid = centred_grid((size_px, size_px), element.layout.pitch_um)
        views = [element.optics(um).model_copy(update={"distance_um": distance_um}) for um in COLOURS_UM]
        self.propagators = [make_propagator(grid, grid, view) for view in views]
        self.wave = torch.full((size_px, size_px), 1 / size_px, dtype=torch.complex64)

    def images(self, element: litho_design.Element) -> torch.Tensor:
        """Return the share of the incident light on each pixel, for each colour. The result has shape
        (3, size, size).
        """
        height = element.height_um()  # the element is printed once, for all colours
        waves = [element(self.wave, um, height) for um in COLOURS_UM]
        return torch.stack(
            [go(wave).abs().square() for go, wave in zip(self.propagators, waves, strict=True)]
        )


def loss(images: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Return the rms error of the worst colour, plus 0.1 times the share of the light outside the discs. The
    error of a colour is computed at the brightness that fits its target best.
    """
    scale = (images * targets).sum((1, 2)) / images.square().sum((1, 2))
    error = (scale[:, None, None] * images - targets).square().mean((1, 2)).sqrt()
    return error.max() + 0.1 * (1 - (images * targets).sum((1, 2))).mean()


def main() -> None:
    """Design one element for a perfect printer and one with a model, and print both with the model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", help="folder of a frozen model, or zoo:NAME")
    parser.add_argument("--size-px", type=int, default=256, help="side of the element in pixels")
    parser.add_argument("--distance-um", type=float, default=60, help="distance of the image in µm")
    parser.add_argument("--iterations", type=int, default=150, help="number of iterations of each search")
    words = parser.parse_args()
    layout = {"size_px": words.size_px, "cell_um": 0.2}
    judge, targets = litho_design.Element(words.model, layout), discs(words.size_px)
    scene = Scene(words.size_px, words.distance_um, judge)
    for name in ("none", words.model):
        element = litho_design.Element(name, layout)
        optimiser = torch.optim.Adam(element.free.parameters(), lr=0.5)
        for _ in range(words.iterations):
            optimiser.zero_grad()
            loss(scene.images(element), targets).backward()
            optimiser.step()
        judge.start_from_levels(element.levels())
        with torch.no_grad():
            seen = scene.images(judge)
        shares = ", ".join(f"{100 * share:.1f} %" for share in (seen * targets).sum((1, 2)).tolist())
        print(
            f"designed with {name}: after printing, the loss is {float(loss(seen, targets)):.4f}, and the "
            f"shares of the light on the three discs are {shares}"
        )


if __name__ == "__main__":
    run_script(main)
