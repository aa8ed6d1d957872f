"""Design an element with 13 levels that splits a beam into 7 x 7 equal spots in the far field (a fan-out),
and compare it with continuous phases.

    python -m benchmarks.fan_out [--publish]

The element is 12.8 µm wide. Adjacent spots are two diffraction limits apart. The power and the uniformity of
the spots are computed for the printed layout. The printer is either the Physics model of the zoo or an ideal
printer that prints the nominal heights. The element is compared with a continuous phase that is designed with
the same loss, and with the phase of the Gerchberg-Saxton algorithm. The latter is used both as it is and
rounded to the nearest of 13 levels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin
from litho_data.commands.progress import run_script
from litho_data.reports.pictures import new_figure
from litho_design import Task, design, design_settings, load_design, load_printer, register_task
from litho_design.optimisation.phases import gerchberg_saxton, nearest_levels, printed_phase

PAGE = Path(__file__).parents[1] / "docs" / "optics.md"
RESULT = PAGE.parent / "results" / "fan-out" / "fan_out.json"
NAME = "fan-out"
SIZE_PX, PITCH_UM, LIMITS_APART = 128, 0.1, 2
# The diffraction limit, wavelength times focal length over width, is 0.3 µm, which is three pixels of the
# image.
FOCAL_UM = 0.3 * SIZE_PX * PITCH_UM / 0.6328
SETTINGS = {
    "layout.size_px": SIZE_PX,
    "layout.cell_um": 0.2,
    "optics.distance_um": FOCAL_UM,
    "optics.propagation": "far-field",
    "search.start": "gs",
    "search.iterations": 150,
    "search.learning_rate": 0.5,
    "search.polish_rounds": 50,
    "window.yield_draws": 2,
    "window.defocus_sd_um": 0.0,
}
PRINTER = "zoo:physics"


@register_task
class FanOut(Task):
    """The task of making 49 spots of equal power. The scores are their total power and their uniformity."""

    name = "fan-out"
    starts = ("random", "gs")
    headline = ("efficiency", "uniformity_error")
    errors = ("uniformity_error",)

    def powers(self, seen: Tensor) -> Tensor:
        """Return the share of the power in each spot, shape (49,). A spot extends to 2/3 of a diffraction
        limit from its centre.
        """
        return torch.einsum("kyx,vyx->k", _spots().to(seen), seen)

    def start_levels(self, level_phase: Tensor) -> Tensor:
        """Return the levels nearest to the Gerchberg-Saxton phase."""
        return nearest_levels(_gerchberg_saxton(self), level_phase)

    def loss(self, seen: Tensor) -> Tensor:
        """Return the share of the light outside the spots, plus the relative standard deviation of the spots'
        powers.
        """
        powers = self.powers(seen)
        return 1 - powers.sum() + powers.std(correction=0) / powers.mean()

    def figures(self, seen: Tensor) -> dict[str, float]:
        """Return the efficiency, which is the light in all spots, and the uniformity error. The latter is
        (high - low) / (high + low), with the highest and the lowest power of a spot.
        """
        powers = self.powers(seen)
        low, high = float(powers.min()), float(powers.max())
        return {"efficiency": float(powers.sum()), "uniformity_error": (high - low) / (high + low)}


def main() -> None:
    """Design and compare the elements, write the record, print the table, and draw the figure."""
    given = options(
        __doc__,
        "write the record, the table and the figure into the documentation",
        Path("runs/fan_out.json"),
    ).parse_args()
    torch.set_num_threads(1)
    settings = design_settings(SETTINGS)
    nominal, printer = (load_printer(source, settings.layout) for source in ("none", PRINTER))
    task = FanOut(settings, nominal)
    seen: dict[str, Tensor] = {}
    for name, phase in _phases(task).items():
        seen[name] = task.bench(_height_um(task, phase))
        if name != "continuous phase, same loss":
            level = nearest_levels(phase, printed_phase(nominal.level_heights_um(), settings.optics))
            seen[f"{name}, 13 levels"] = task.bench(task.printed_um(task.cells(level)))
    with TemporaryDirectory() as folder:
        for model, name in ((nominal, "nominal heights"), (printer, "Physics")):
            place = Path(folder) / name
            design(FanOut, model, place, settings=settings, judges=(), announce=False)
            loaded = load_design(place)
            for by, press in (("nominal heights", nominal), ("Physics", printer)):
                if model is printer or by == "Physics":
                    seen[f"designed for {name}, printed by {by}"] = loaded.bench(loaded.printed_um(press))
            if model is nominal:
                seen["designed for nominal heights"] = loaded.bench(loaded.printed_um(nominal))
    rows = {name: task.figures(image) for name, image in seen.items()}
    record = {"schema": "litho-design/benchmark-fan-out/1", **origin(), "settings": SETTINGS, "rows": rows}
    out = RESULT if given.publish else given.out
    conclude(record, as_markdown(record), out, PAGE, NAME, published=given.publish)
    _draw(task, seen, out.with_suffix(".jpg"))


def as_markdown(record: Mapping[str, Any]) -> str:
    """Return a table with one row for each element."""
    lines = [
        (name, f"{100 * row['efficiency']:.1f} %", f"{100 * row['uniformity_error']:.1f} %")
        for name, row in record["rows"].items()
    ]
    return markdown_table(("element", "light in the 49 spots", "uniformity error"), lines)


def _spots() -> Tensor:
    """Return a mask of each spot, in an array of shape (49, size, size)."""
    place = torch.arange(SIZE_PX) - (SIZE_PX - 1) / 2
    apart = LIMITS_APART * 3
    middles = apart * torch.arange(-3, 4)
    near = [(place - middle).square() for middle in middles]
    return torch.stack([(y[:, None] + x[None, :] <= 4).float() for y in near for x in near])


def _phases(task: FanOut) -> dict[str, Tensor]:
    """Return the continuous phases by name, each with the phase of every cell in radians."""
    phase = _gerchberg_saxton(task)
    free = phase.clone().requires_grad_()
    optimiser = torch.optim.Adam([free], lr=0.1)
    for _ in range(task.settings.search.iterations):
        optimiser.zero_grad()
        task.loss(task.bench(_height_um(task, free))).backward()
        optimiser.step()
    return {"continuous phase, same loss": free.detach(), "Gerchberg–Saxton": phase}


def _gerchberg_saxton(task: FanOut) -> Tensor:
    """Return the phase of every cell, in radians, after sixty steps of the Gerchberg-Saxton algorithm."""
    target, bench = _spots().sum(0), task.bench.benches[0]
    return gerchberg_saxton(
        bench.propagator, target, task.cells, bench.illumination(), iterations=60, weighted=False, seed=0
    )[0]


def _height_um(task: FanOut, phase: Tensor) -> Tensor:
    return task.cells(phase) * (task.settings.optics.wave_height_um / (2 * math.pi))


def _draw(task: FanOut, seen: Mapping[str, Tensor], path: Path) -> None:
    """Draw the image of the designed element, and the power of each spot relative to the mean power."""
    shown = [name for name in seen if "13 levels" in name or name.startswith(("continuous", "designed"))]
    figure = new_figure(10, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    image = seen["designed for nominal heights"][0].detach().numpy()
    left.imshow(image, cmap="inferno", vmax=float(np.quantile(image, 0.995)))
    left.set(title="13 levels, nominal heights", xticks=[], yticks=[])
    for name in shown:
        powers = task.powers(seen[name]).detach()
        right.semilogy(np.sort((powers / powers.mean()).numpy()), label=name)
    right.set(xlabel="spot, by power", ylabel="power over the mean", ylim=(0.05, 50))
    right.legend(fontsize=7)
    figure.savefig(path, dpi=90, bbox_inches="tight", pil_kwargs={"quality": 85})


if __name__ == "__main__":
    run_script(main)
