"""Add an optical task of your own, here three colours in three planes. Elements for it are designed,
compared, exported and scored like those of the package's tasks.

    python examples/own_task.py zoo:pbl --out rgb-planes

A class defines the images (``views``), the quantity that the search minimises (``loss``) and the scores
(``figures``). Everything else (search, checkpoints, polish, process window, report, comparison and export)
works as for holograms and lenses.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import litho_design
from litho_data.commands.progress import run_script

NANOMETRES, PLANES_UM = (640, 532, 473), (-4.0, 0.0, 4.0)


@litho_design.register_task
class ColoursInPlanes(litho_design.Task):
    """The task of drawing one spot per colour, each of which is sharp in three planes."""

    name = "colours-in-planes"

    def views(self, optics):
        colours = [optics.at_wavelength(1e-3 * nm) for nm in NANOMETRES]
        return [c.model_copy(update={"distance_um": c.distance_um + z}) for c in colours for z in PLANES_UM]

    def loss(self, seen):
        targets = torch.from_numpy(self.inputs["targets"]).to(seen).repeat_interleave(len(PLANES_UM), 0)
        return -(seen * targets).sum((1, 2)).log().mean()

    def figures(self, seen):
        share = (seen * torch.from_numpy(self.inputs["targets"]).to(seen).repeat_interleave(3, 0)).sum((1, 2))
        return {"mean_on_spots": float(share.mean()), "worst_on_spots": float(share.min())}


def spots(size_px: int) -> np.ndarray:
    """Return a picture with one round spot for each of the three colours, as float32 of shape (3, size,
    size).
    """
    y, x = np.mgrid[0:size_px, 0:size_px] / size_px
    places = ((0.3, 0.3), (0.3, 0.7), (0.7, 0.5))
    return np.stack([np.hypot(y - v, x - u) < 0.06 for v, u in places]).astype(np.float32)


def main() -> None:
    """Make one design for a perfect printer and one with a model, compare their prints, and export the second
    one.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", help="folder of a frozen model, or zoo:NAME")
    parser.add_argument("--out", type=Path, default=Path("colours-in-planes"), help="folder of the result")
    parser.add_argument("--size-px", type=int, default=256, help="side of the element in pixels")
    parser.add_argument("--iterations", type=int, default=100, help="number of iterations of each search")
    words = parser.parse_args()
    changes = {
        "layout.size_px": words.size_px,
        "optics.distance_um": 25,
        "search.iterations": words.iterations,
    }
    settings = litho_design.design_settings(changes)
    result = litho_design.compare(
        settings,
        {"none": "none", "model": words.model},
        words.out,
        seeds=(0,),
        task=ColoursInPlanes,
        inputs={"targets": spots(words.size_px)},
    )
    for item in result.summary:
        if item.figure == "worst_on_spots" and item.judge == "model":
            print(
                f"designed with {item.arm}: the worst spot gets {100 * item.judged_mean:.1f} % of the light"
            )
    best = words.out / "designs" / "model" / "seed0"
    print(litho_design.export(best, "png16", words.out / "to-printer"))
    score = litho_design.score(best, words.out / "score", judges=["none"])
    print(f"score.json: {', '.join(score.scores[0].figures)}")


if __name__ == "__main__":
    run_script(main)
