"""Add a model of the printer of your own. It is then trained, frozen and loaded by its name, like the models
of the package.

    python examples/own_simulator.py STORE.zarr --out FOLDER

The script registers a model whose spot is the sum of two Gaussians, and trains it as `litho-models train`
does. Nothing else needs to change: the functions for benchmarks, the closed loop and designs accept the name
of the model. If you put `@register_simulator` above the class in a plug-in (docs/extending.md), all commands
accept it, too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor, nn

from litho_data.commands.progress import run_script
from litho_models import Simulator, freeze, load_frozen, register_simulator, train
from litho_models.layers.ranges import Range
from litho_models.models.parts import illuminate, spot_radius_px


class TwoSpots(Simulator):
    """A printer with the height H = gain · ((1 - share) G_narrow + share G_wide) \\* M. M is the layout's
    height, and \\* is a convolution with the Gaussians G.
    """

    name = "two-spots"

    def __init__(self, config):
        super().__init__(config)
        for (key, own), start in zip(self.ranges.items(), (0.2, 1.0, 0.2), strict=True):
            self.register_parameter(key, nn.Parameter(own.raw(start)))
        self.gain = nn.Parameter(torch.tensor(1.0))

    @property
    def ranges(self) -> dict[str, Range]:
        return {
            "narrow": Range("narrow_um", 0.0, 0.8),
            "wide": Range("wide_um", 0.0, 4.0),
            "share": Range("share", 0.0, 1.0),
        }

    @property
    def reach_px(self) -> int:
        narrow, wide, _ = self._values()
        return max(spot_radius_px(width, self.pitch_um) for width in (narrow, wide))

    def interior(self, layout_um: Tensor) -> Tensor:
        narrow, wide, share = self._values()
        return self.gain * illuminate(
            layout_um, [(1 - share, narrow), (share, wide)], self.pitch_um, self.reach_px
        )

    def _values(self) -> list[Tensor]:
        return [own.value(getattr(self, key)) for key, own in self.ranges.items()]


def main() -> None:
    """Register the model, train it, freeze it, and print the name of the frozen model."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("store", help="dataset store")
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the training run and of the frozen model"
    )
    given = parser.parse_args()
    register_simulator(TwoSpots)
    train(given.store, TwoSpots.name, given.out / "run")
    freeze(given.out / "run", given.out / "model")
    frozen = load_frozen(given.out / "model")
    print(f"{frozen.name} is frozen in {given.out / 'model'}")


if __name__ == "__main__":
    run_script(main)
